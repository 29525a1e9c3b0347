"""Long work that leaves the window alive: a thread does it, a modal operator watches it.

A function of `addon` returns a `Job`; an operator that inherits from `JobOperator` does it. Started from the window
(INVOKE), it runs in a thread, until Esc or the panel's button cancels it. Called from a script (EXEC) or without a window,
the operator returns when the job is done. Scripts can also do a job themselves, with `run`.
"""

import threading
import time
import traceback
from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import bpy
from bpy.props import BoolProperty

from ..core.cli.options import progress_bar
from ..core.errors import InputError
from ..core.progress import Cancelled, Progress
from ..core.recording import recorded_warnings
from . import ids
from .reports import warnings_reported

_INTERVAL = 0.1  # s between two looks at the thread
_STEP = 0.05  # s that finishing may take of the main thread before the window is drawn again
_PATIENCE = 10.0  # s that `stop` waits for a thread


@dataclass
class Job:
    """Work to do, and what to do with its result.

    ``work(progress)`` runs in a thread and must not touch bpy; ``progress(done, total)`` raises `Cancelled` when the user
    wants to stop. ``finish(result)`` runs in the main thread and returns the line to report; if that takes long, it is a
    generator that yields between its steps, so that the window can be drawn.
    """

    label: str
    work: Callable[[Progress], Any]
    finish: Callable[[Any], str | Generator[None, None, str]]


def run(job: Job, progress: Progress = lambda done, total: None) -> str:
    """Do a job now; returns the line to report, raises what the work raises."""
    steps = _finishing(job, job.work(progress))
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return str(end.value)


def _finishing(job: Job, result: Any) -> Generator[None, None, str]:
    finished = job.finish(result)
    return (yield from finished) if isinstance(finished, Generator) else finished


class Worker(threading.Thread):
    """The thread that does a job's work, with its progress and the warnings that it gave."""

    def __init__(self, label: str, work: Callable[[Progress], Any]) -> None:
        super().__init__(name=f"mphDRR: {label}", daemon=True)
        self.label, self.work = label, work
        self.done = self.total = 0
        self.result: Any = None
        self.error: BaseException | None = None
        self.caught: list[str] = []
        self.cancel = threading.Event()

    def run(self) -> None:
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


@bpy.app.handlers.persistent
def stop(*_: Any) -> None:
    """Stop the running job and wait for its thread: before a file is loaded, or the extension is disabled."""
    global _current
    worker, _current = _current, None
    if worker is not None:
        worker.cancel.set()
        worker.join(_PATIENCE)


class JobOperator:
    """Mix into an operator and implement `job`; say in `asks_for` or `dialog` what the user is asked for first."""

    bl_options = {"REGISTER", "UNDO"}

    confirmed: BoolProperty(
        name="Confirmed", description="Start without asking", options={"HIDDEN", "SKIP_SAVE"}, default=False
    )

    asks_for = ""
    """The property that a file browser sets, unless it is given, as by dropping a file on the window."""
    dialog: dict[str, Any] | None = None
    """How a dialog of the operator's properties looks: `confirm_text` on its button, `width`."""

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
        """The job, from the operator's and the scene's settings; raises InputError."""
        raise NotImplementedError

    def ask(self, context: bpy.types.Context) -> set[str] | None:
        """Open a dialog or a file browser, whose button starts the job; None where there is nothing to ask."""
        if self.dialog is not None:
            return context.window_manager.invoke_props_dialog(self, title=self.bl_label, **self.dialog)
        if not self.asks_for or getattr(self, self.asks_for):
            return None
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Do the job at once and return when it is done."""
        if self._asked:
            return self._start_after_asking()
        try:
            _require_idle()
            with warnings_reported(self):
                job = self.job(context)
                text = run(job, progress_bar(job.label))
            self.report({"INFO"}, text)
        except BaseException as error:
            return self._failed(error)
        return {"FINISHED"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Start the job in a thread; without a window, do it at once."""
        global _current
        if bpy.app.background or context.window is None:
            return self.execute(context)
        try:
            _require_idle()
            asked = None if self.confirmed else self.ask(context)
            if asked is not None:
                self._asked = True
                return asked
            with warnings_reported(self):
                self._job = self.job(context)
        except Exception as error:
            return self._failed(error)
        self._run = _current = Worker(self._job.label, self._job.work)
        _current.start()
        manager = context.window_manager
        self._timer = manager.event_timer_add(_INTERVAL, window=context.window)
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Watch the thread; when it is done, finish step by step."""
        job, worker = self._job, self._run
        if job is None or worker is None or worker is not _current:  # stopped from outside
            self._end(context)
            return {"CANCELLED"}
        if event.type == "ESC" and event.value == "PRESS":
            worker.cancel.set()
            return {"RUNNING_MODAL"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        redraw_sidebars()
        if worker.is_alive():
            return {"PASS_THROUGH"}
        try:
            if self._finishing is None:
                for text in worker.caught:
                    self.report({"WARNING"}, text)
                if worker.error is not None or worker.cancel.is_set():
                    raise worker.error or Cancelled()
                self._finishing = _finishing(job, worker.result)
            enough = time.perf_counter() + _STEP
            while time.perf_counter() < enough:
                next(self._finishing)
        except StopIteration as end:
            self._end(context)
            self.report({"INFO"}, end.value)
            return {"FINISHED"}
        except BaseException as error:
            self._end(context)
            return self._failed(error)
        return {"PASS_THROUGH"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator: its window closes, or another file is loaded."""
        if self._run is not None and self._run is _current:
            stop()
        self._end(context)

    def _start_after_asking(self) -> set[str]:
        """Blender calls `execute` after a dialog, which cannot become modal: start another operator of this kind."""
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


def _require_idle() -> None:
    if is_running():
        raise InputError("another job is running: wait for it or cancel it")


class MPHDRR_OT_cancel_job(bpy.types.Operator):
    """Stop the running job; the scene stays as it was"""

    bl_idname = ids.CANCEL_JOB
    bl_label = "Cancel"
    bl_options = {"INTERNAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Ask it to stop at its next step."""
        if _current is not None:
            _current.cancel.set()
        return {"FINISHED"}


def draw_job(layout: bpy.types.UILayout) -> None:
    """Draw the running job's progress bar and Cancel button; nothing where there is none."""
    if _current is not None:
        share = _current.done / max(1, _current.total)
        row = layout.row(align=True)
        row.progress(factor=share, type="BAR", text=f"{_current.label}  {share:.0%}")
        row.operator(ids.CANCEL_JOB, text="", icon="CANCEL")


def _argument(value: Any) -> Any:
    """An operator's setting, as another operator takes it."""
    if isinstance(value, bpy.types.bpy_prop_array):
        return tuple(value)
    if isinstance(value, bpy.types.bpy_prop_collection):  # of files
        return [{"name": item.name} for item in value]
    return value


def redraw_sidebars() -> None:
    """Have the panels drawn, but not the scene: ten times a second, that would slow the work down."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            for region in area.regions:
                if area.type == "VIEW_3D" and region.type == "UI":
                    region.tag_redraw()
