"""Long work that leaves the window alive: a thread does it, a modal operator watches it.

An operator that inherits from `JobOperator` gives its work as a `Job`. Called from the window (INVOKE) it runs as a
modal job with a progress bar, cancelled by Esc or by the panel's button; called from a script (EXEC) or in
background mode the same work runs at once and the operator returns when it is done. The work must not touch bpy.
"""

from __future__ import annotations

import sys
import threading
import time
import traceback
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import bpy
from bpy.props import BoolProperty, FloatProperty, StringProperty

from ..core.errors import InputError
from ..core.progress import Cancelled, Progress
from ..core.recording import recorded_warnings
from . import ids
from .reports import warnings_reported

_INTERVAL = 0.1  # s between two looks at the thread
_STEP = 0.05  # s of the main thread's time for finishing, each time
_PATIENCE = 10.0  # s that stopping waits for a thread


@dataclass
class Job:
    """Work to do, and what to do with its result.

    Attributes
    ----------
    label : str
        What the progress bar calls it.
    work : callable
        ``work(progress)`` runs in a thread and must not touch bpy. It calls ``progress(done, total)`` between its
        steps, where `Cancelled` is raised when the user wants so.
    finish : callable
        ``finish(result)`` is a generator that runs in Blender's main thread: it yields between small steps, so that
        the window can be drawn, and returns the line to report.
    """

    label: str
    work: Callable[[Progress], Any]
    finish: Callable[[Any], Generator[None, None, str]]


@dataclass
class Worker:
    """Work in a thread of its own, with its progress and the warnings it gave; the main thread starts it."""

    label: str
    work: Callable[[Progress], Any]
    done: int = 0
    total: int = 0
    result: Any = None
    error: BaseException | None = None
    caught: list[str] = field(default_factory=list)
    cancel: threading.Event = field(default_factory=threading.Event)
    thread: threading.Thread | None = None

    def start(self) -> None:
        self.thread = threading.Thread(target=self._work, name=f"mphDRR: {self.label}", daemon=True)
        self.thread.start()

    @property
    def alive(self) -> bool:
        return self.thread is not None and self.thread.is_alive()

    def _work(self) -> None:
        with recorded_warnings() as self.caught:
            try:
                self.result = self.work(self._progress)
            except BaseException as error:
                self.error = error

    def _progress(self, done: int, total: int) -> None:
        self.done, self.total = done, total
        if self.cancel.is_set():
            raise Cancelled


_current: Worker | None = None


def is_running() -> bool:
    """Whether a job runs in a thread now."""
    return _current is not None


def cancel() -> None:
    """Ask the running job to stop at its next step."""
    if _current is not None:
        _current.cancel.set()


def stop() -> None:
    """Stop the running job and wait for its thread: before a file is loaded, or the extension is disabled."""
    global _current
    run, _current = _current, None
    if run is not None:
        run.cancel.set()
        if run.thread is not None:
            run.thread.join(_PATIENCE)


@bpy.app.handlers.persistent
def before_load(*_: Any) -> None:
    """A job does not outlive its scene."""
    stop()


# Named functions, because a lambda in an annotation does not see this module's names.
def _get_running(self: JobProperties) -> bool:
    return is_running()


def _get_label(self: JobProperties) -> str:
    return _current.label if _current else ""


def _get_progress(self: JobProperties) -> float:
    return _current.done / _current.total if _current and _current.total else 0.0


class JobProperties(bpy.types.PropertyGroup):
    """The running job; `WindowManager.mphdrr_job`, read-only."""

    running: BoolProperty(name="Running", get=_get_running)
    label: StringProperty(name="Job", get=_get_label)
    progress: FloatProperty(
        name="Progress", description="Share of the work that is done", min=0.0, max=1.0, subtype="FACTOR",
        get=_get_progress,
    )  # fmt: skip


class JobOperator:
    """Mix into an operator and implement `job`, and `ask` where the user is asked first; add nothing else but properties."""

    confirmed: BoolProperty(
        name="Confirmed", description="Start without asking", options={"HIDDEN", "SKIP_SAVE"}, default=False
    )

    _asked = False
    _job: Job | None = None
    _run: Worker | None = None
    _finishing: Generator[None, None, str] | None = None
    _timer: bpy.types.Timer | None = None

    if TYPE_CHECKING:  # what every bpy.types.Operator has
        bl_idname: str
        bl_label: str

        def report(self, type: set[str], message: str) -> None: ...
        def as_keywords(self, *, ignore: tuple[str, ...] = ()) -> dict[str, Any]: ...

    def job(self, context: bpy.types.Context) -> Job:
        """The work, from the operator's and the scene's settings; raises InputError."""
        raise NotImplementedError

    def ask(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str] | None:
        """Open a dialog or a file browser, whose button starts the work; None where there is nothing to ask."""
        return None

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Do the work at once and return when it is done."""
        if self._asked:
            return self._start_after_asking()
        if is_running():
            self.report({"ERROR"}, "another job is running: wait for it or cancel it")
            return {"CANCELLED"}
        try:
            job = self.job(context)
            with warnings_reported(self):
                result = job.work(_console(job.label) if bpy.app.background else _cursor(context))
            self.report({"INFO"}, _last(job.finish(result)))
        except BaseException as error:
            return self._failed(error)
        finally:
            context.window_manager.progress_end()
        return {"FINISHED"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Start the work in a thread; without a window, do it at once."""
        global _current
        if bpy.app.background or context.window is None:
            return self.execute(context)
        if is_running():
            self.report({"ERROR"}, "another job is running: wait for it or cancel it")
            return {"CANCELLED"}
        if not self.confirmed:
            asked = self.ask(context, event)
            if asked is not None:
                self._asked = True
                return asked
        try:
            self._job = self.job(context)
        except Exception as error:
            return self._failed(error)
        self._run = _current = Worker(self._job.label, self._job.work)
        self._run.start()
        manager = context.window_manager
        self._timer = manager.event_timer_add(_INTERVAL, window=context.window)
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Watch the thread; when it is done, finish step by step."""
        job, run = self._job, self._run
        if job is None or run is None or run is not _current:  # stopped from outside
            self._end(context)
            return {"CANCELLED"}
        if event.type == "ESC" and event.value == "PRESS":
            cancel()
            return {"RUNNING_MODAL"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        redraw_sidebars()
        if run.alive:
            return {"PASS_THROUGH"}
        if self._finishing is None:
            for text in run.caught:
                self.report({"WARNING"}, text)
            error = run.error or (Cancelled() if run.cancel.is_set() else None)
            if error is not None:
                self._end(context)
                return self._failed(error)
            self._finishing = job.finish(run.result)
        try:
            enough = time.perf_counter() + _STEP
            while time.perf_counter() < enough:
                next(self._finishing)
        except StopIteration as end:
            self._end(context)
            self.report({"INFO"}, end.value)
            return {"FINISHED"}
        except Exception as error:
            self._end(context)
            return self._failed(error)
        return {"PASS_THROUGH"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator: its window closes, or another file is loaded."""
        if self._run is not None and self._run is _current:
            stop()
        self._end(context)

    def _start_after_asking(self) -> set[str]:
        """Blender runs what a dialog asked for by `execute`, which cannot become modal: start another of this kind."""
        given = {name: _argument(value) for name, value in self.as_keywords(ignore=("confirmed",)).items()}
        group, name = self.bl_idname.split("_OT_")  # an instance has the class's name there
        try:
            getattr(getattr(bpy.ops, group.lower()), name)("INVOKE_DEFAULT", confirmed=True, **given)
        except RuntimeError as error:  # what the other one reported
            self.report({"ERROR"}, str(error).removeprefix("Error: ").strip())
        return {"CANCELLED"}

    def _end(self, context: bpy.types.Context) -> None:
        global _current
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
            self._timer = None
        if _current is self._run:
            _current = None
        redraw_sidebars()

    def _failed(self, error: BaseException) -> set[str]:
        if isinstance(error, Cancelled):
            self.report({"WARNING"}, f"{self.bl_label}: cancelled, nothing was changed")
        elif isinstance(error, InputError):
            self.report({"ERROR"}, str(error))
        elif isinstance(error, MemoryError):
            self.report({"ERROR"}, f"{self.bl_label}: not enough memory; choose fewer voxels or pixels")
        elif isinstance(error, Exception):
            traceback.print_exception(error)
            self.report({"ERROR"}, f"{self.bl_label} failed: {type(error).__name__}: {error} (details in the console)")
        else:
            raise error  # KeyboardInterrupt and the like
        return {"CANCELLED"}


class MPHDRR_OT_cancel_job(bpy.types.Operator):
    """Cancel the running job: the progress bar's button, and a script's way."""

    bl_idname = ids.CANCEL_JOB
    bl_label = "Cancel"
    bl_description = "Stop the running job; the scene stays as it was"
    bl_options = {"INTERNAL"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """There is a job."""
        if not is_running():
            cls.poll_message_set("No job is running")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Ask it to stop."""
        cancel()
        return {"FINISHED"}


def draw_job(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the running job's progress bar and Cancel button; nothing where there is none."""
    if not is_running():
        return
    state = getattr(context.window_manager, ids.WINDOW_JOB)
    row = layout.row(align=True)
    row.progress(factor=state.progress, type="BAR", text=f"{state.label}  {state.progress:.0%}")
    row.operator(ids.CANCEL_JOB, text="", icon="CANCEL")


def _argument(value: Any) -> Any:
    """An operator's setting, as another operator takes it."""
    if isinstance(value, bpy.types.bpy_prop_array):
        return tuple(value)
    if isinstance(value, bpy.types.bpy_prop_collection):  # of files
        return [{"name": item.name} for item in value]
    return value


def _last(steps: Generator[None, None, str]) -> str:
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return end.value


def redraw_sidebars() -> None:
    """Have the panels drawn: not the scene, which ten times a second would take the processor from the work."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions:
                if area.type == "VIEW_3D" and region.type == "UI":
                    region.tag_redraw()


def _console(label: str) -> Progress:
    shown = -1

    def progress(done: int, total: int) -> None:
        nonlocal shown
        percent = 100 * done // max(1, total)
        if percent >= shown + 10 or done == total:
            shown = percent
            print(f"mphDRR: {label} {percent} % ({done} of {total})", file=sys.stderr, flush=True)

    return progress


def _cursor(context: bpy.types.Context) -> Progress:
    context.window_manager.progress_begin(0, 1000)
    return lambda done, total: context.window_manager.progress_update(1000 * done // max(1, total))
