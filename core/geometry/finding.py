"""What a check finds."""

from typing import ClassVar


class Finding:
    """Something wrong with one module or with a pair of modules; ``str`` gives it in one line."""

    message: ClassVar[str]

    def __str__(self) -> str:
        return self.message.format(self)

    @property
    def modules(self) -> tuple[int, ...]:
        """Numbers of the modules concerned."""
        return tuple(getattr(self, name) for name in ("first", "second", "module", "by") if hasattr(self, name))
