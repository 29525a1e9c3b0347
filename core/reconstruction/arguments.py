"""Arguments of methods and priors that are settings of recipes, declared beside the function that takes them."""

import inspect
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, TypeVar

from ..recipes.settings import Setting

_Taker = TypeVar("_Taker", bound=Callable[..., Any])

ARGUMENTS: dict[str, Setting] = {}
"""Settings by the argument's name, without defaults; these come from the functions' signatures."""


def argument(name: str, kind: type, text: str, absent: str = "", **limits: Any) -> Callable[[_Taker], _Taker]:
    """Declare the setting ``reconstruction.<name>`` of an argument, as a decorator of the method or prior that takes it.

    All methods and priors with an argument of this name share the setting, so it is declared once. `kind`, `text`, `absent`
    and `limits` are those of `Setting`.
    """
    ARGUMENTS[name] = Setting(f"reconstruction.{name}", kind, None, text, absent, **limits)
    return lambda taker: taker


@dataclass(frozen=True)
class Choice:
    """Function or class that a setting chooses by name; its arguments are settings, too."""

    label: str
    """Name in menus."""
    text: str
    """Help text of one line."""
    function: Callable[..., Any]
    """Function or class itself."""

    first: ClassVar[int] = 0
    """Index of the first argument that is a setting."""
    common: ClassVar[Collection[str]] = ()
    """Names of arguments that all choices take, and that therefore are not settings of a single choice."""

    @cached_property
    def own(self) -> Mapping[str, Any]:
        """Defaults of the choice's arguments by name; `inspect.Parameter.empty` for a required argument."""
        arguments = list(inspect.signature(self.function).parameters.values())[self.first :]
        return {
            argument.name: argument.default
            for argument in arguments
            if argument.kind not in (argument.VAR_POSITIONAL, argument.VAR_KEYWORD) and argument.name not in self.common
        }
