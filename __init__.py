"""mphDRR: multi-pinhole SPECT geometry, phantoms and projections, as a Blender extension and a Python package."""

from typing import Any

__version__: str


def __getattr__(name: str) -> Any:
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from .core.version import VERSION

    return VERSION


def register() -> None:
    """Blender enables the extension."""
    from .addon import cli, registration

    registration.register(cli.main)


def unregister() -> None:
    """Blender disables the extension."""
    from .addon import registration

    registration.unregister()
