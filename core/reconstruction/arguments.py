"""Arguments of methods and priors: which of them are settings of recipes, declared beside the function that takes them."""

import inspect
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, TypeVar

from ..recipes.settings import Setting

_Taker = TypeVar("_Taker", bound=Callable[..., Any])

ARGUMENTS: dict[str, Setting] = {}
"""Settings of arguments by the argument's name, without defaults, which are those of the functions."""


def argument(name: str, kind: type, text: str, absent: str = "", **limits: Any) -> Callable[[_Taker], _Taker]:
    """Declare the setting ``reconstruction.<name>`` of an argument; a decorator of the method or prior that takes it.

    All methods and priors with an argument of this name share the setting, so it is declared once. `kind`, `text`, `absent`
    and `limits` are those of `Setting`.
    """
    ARGUMENTS[name] = Setting(f"reconstruction.{name}", kind, None, text, absent, **limits)
    return lambda taker: taker


@dataclass(frozen=True)
class Choice:
    """Function or class that a setting can choose, and whose arguments are settings, too."""

    label: str
    """Name in menus."""
    text: str
    """Line of help."""
    function: Callable[..., Any]

    first: ClassVar[int] = 0
    """Index of the first argument that is a setting."""
    common: ClassVar[Collection[str]] = ()
    """Names of arguments that are no settings of their own, because all choices take them."""

    @cached_property
    def own(self) -> Mapping[str, Any]:
        """The defaults of the arguments by their names; `inspect.Parameter.empty` of one that must be given."""
        arguments = list(inspect.signature(self.function).parameters.values())[self.first :]
        return {
            argument.name: argument.default
            for argument in arguments
            if argument.kind not in (argument.VAR_POSITIONAL, argument.VAR_KEYWORD) and argument.name not in self.common
        }
