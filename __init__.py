"""mphDRR: multi-pinhole SPECT geometry, phantoms and projections, as a Blender extension and a Python package."""

from .core.version import VERSION

__version__ = VERSION


def register() -> None:
    """Blender enables the extension."""
    from .addon import cli, registration

    registration.register(cli.main)


def unregister() -> None:
    """Blender disables the extension."""
    from .addon import registration

    registration.unregister()
