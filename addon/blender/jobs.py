"""Long work that leaves the window alive: a thread does it, a modal operator watches it.

A function of `addon` returns a `Job`; an operator that inherits from `JobOperator` does it. Started from the window
(INVOKE), it runs in a thread, after those that were started before it, until Esc or a button cancels it. Called from a
script (EXEC) or without a window, the operator returns when the job is done. Scripts can also do a job themselves, with
`run`.
"""

import itertools
import threading
import time
import traceback
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
from bpy.app.translations import pgettext_iface as iface
from bpy.props import BoolProperty, IntProperty
from bpy_extras.io_utils import ExportHelper

from ...core.cli.options import progress_bar
from ...core.errors import InputError
from ...core.progress import Cancelled, Progress, StagedProgress
from ...core.recording import recorded_warnings
from . import reports, storage, windows

_INTERVAL = 0.1  # s between two looks at the thread, and between two drawings of how far it is
_STEP = 0.02  # s that finishing may take of the main thread before the window has its turn, which is as long
_SHARE, _MOST = 0.1, 0.05  # of the time since the last step, and s, that it may take where the window is drawn slowly
_PATIENCE = 0.2  # s that `stop` waits for a thread; one that takes longer ends by itself, and nobody takes its result
_STATUS_UNITS = 16  # the job's width in the status bar
_SOON = 1.0  # s of a stage after which the time left is guessed

Finishing = Generator[tuple[str, int, int] | None, None, str]
"""Steps of the main thread, between which the window is drawn; returns the line to report.

A step that can be cancelled yields its stage, what is done of it, and its total; one that can not yields None. Where all of
a stage is done, the window has its turn.
"""


@dataclass
class Job:
    """Work to do, and what to do with its result.

    ``work(progress)`` runs in a thread and must not touch bpy; ``progress(done, total)`` raises `Cancelled` when the user
    wants to stop, `stages_of` gives its stages. ``finish(result)`` runs in the main thread and returns the line to report;
    if that takes long, it is a generator (`Finishing`). Where the user cancels, its last yield raises `Cancelled`: by then
    it has changed nothing that it does not take back. ``discard()`` removes what the work has left on disk and what
    ``look()`` has shown, where the job ends before it has finished. ``left()`` says what a job that the user has cancelled
    leaves behind.

    ``look()`` is called in the main thread while the work runs in another, ten times a second: it may show what there is so
    far. A work that sees that `enough` is set ends early, as if it were done: the user has pressed Finish Now.
    """

    label: str
    work: Callable[[Progress], Any]
    finish: Callable[[Any], str | Finishing]
    discard: Callable[[], None] = lambda: None
    look: Callable[[], None] = lambda: None
    enough: threading.Event | None = None
    left: Callable[[], str] = lambda: "nothing was changed"


def run(job: Job, progress: Progress = lambda done, total: None) -> str:
    """Do a job now; returns the line to report, raises what the work raises."""
    try:
        steps = _finishing(job, job.work(progress))
        while True:
            try:
                next(steps)
            except StopIteration as end:
                return str(end.value)
    except BaseException:
        job.discard()
        raise


def _finishing(job: Job, result: Any) -> Finishing:
    finished = job.finish(result)
    return (yield from finished) if isinstance(finished, Generator) else finished


def scene_again(uid: int, what: str) -> bpy.types.Scene:
    """The scene that a job was started for, by its `session_uid`; `InputError`, for `what` it was, where it is gone."""
    scene = found_again(bpy.data.scenes, uid)
    if scene is None:
        raise InputError(f"the scene that {what} for is gone")
    return scene


def found_again(datablocks: Any, uid: int) -> Any:
    """What had this `session_uid` when a job began, under whatever name now; None where it is gone."""
    return next((item for item in datablocks if item.session_uid == uid), None)


class Worker(threading.Thread):
    """The thread that does a job's work, with its stage and the warnings that it gave; later, the steps that finish it."""

    _numbers = itertools.count(1)

    def __init__(self, label: str, work: Callable[[Progress], Any], enough: threading.Event | None = None) -> None:
        super().__init__(name=f"mphDRR: {label}", daemon=True)
        self.label, self.work, self.number, self.enough = label, work, next(self._numbers), enough
        self.stage, self.since = label, time.monotonic()
        self.done = self.total = 0
        self.result: Any = None
        self.error: BaseException | None = None
        self.caught: list[str] = []
        self.cancel = threading.Event()
        self.steps: Finishing | None = None
        self._can_stop = False

    def run(self) -> None:
        with recorded_warnings() as self.caught:
            try:
                self.result = self.work(StagedProgress(self._begin, self.label))
            except BaseException as error:
                self.error = error

    @property
    def share(self) -> float:
        """How much of the stage is done."""
        return min(1.0, self.done / max(1, self.total))

    @property
    def text(self) -> str:
        """The stage in words: how far it is, and how long it takes."""
        words, seconds = self.stage[:1].upper() + self.stage[1:], time.monotonic() - self.since
        if self.cancel.is_set():
            return f"{words}: stopping"
        if self.total < 2:
            return f"{words}, {seconds:.0f} s" if seconds > _SOON else words
        words = f"{words} {self.done} of {self.total}"
        if seconds < _SOON or not self.done:
            return words
        left = seconds / self.done * (self.total - self.done)
        return f"{words}, {f'{left:.0f} s' if left < 100 else f'{left / 60:.0f} min'} left"

    @property
    def is_stoppable(self) -> bool:
        """Whether the user has cancelled it and finishing can be stopped after its last step."""
        return self.cancel.is_set() and self._can_stop

    def show_step(self, step: tuple[str, int, int] | None) -> None:
        """Note a step of finishing."""
        self._can_stop = step is not None
        if step is not None:
            self.show(*step)

    def show(self, stage: str, done: int, total: int) -> None:
        """Note how far a stage is."""
        if stage != self.stage:
            self.stage, self.since = stage, time.monotonic()
        self.done, self.total = done, total

    def _begin(self, stage: str) -> Progress:
        def progress(done: int, total: int) -> None:
            self.show(stage, done, total)
            if self.cancel.is_set():
                raise Cancelled

        self.since = time.monotonic()
        progress(0, 0)
        return progress


_current: Worker | None = None
_waiting: list[Worker] = []


def is_running() -> bool:
    """Whether a job runs in a thread now, or waits for its turn."""
    return _current is not None or bool(_waiting)


def stop(*_: Any) -> None:
    """Stop all jobs, and wait a moment for the running one's thread: before a file is loaded, or the extension disabled."""
    global _current
    worker, _current = _current, None
    _waiting.clear()
    if worker is not None:
        worker.cancel.set()
        worker.join(_PATIENCE)
        if worker.steps is not None:
            worker.steps.close()


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
    _timer: bpy.types.Timer | None = None
    _drawn = _left = 0.0

    if TYPE_CHECKING:  # what every bpy.types.Operator has
        bl_idname: str
        bl_label: str
        properties: Any
        filepath: str  # of one that reads or writes a file

        def report(self, type: set[str], message: str) -> None: ...
        def as_keywords(self, *, ignore: tuple[str, ...] = ()) -> dict[str, Any]: ...

    def job(self, context: bpy.types.Context) -> Job:
        """The job, from the operator's and the scene's settings; raises InputError."""
        raise NotImplementedError

    def given(self, panel: bpy.types.PropertyGroup, *names: str) -> list[Any]:
        """The values of settings: each that of the operator where it is given, else the panel's."""
        return list(map(self.given_or(panel), names))

    def given_or(self, panel: bpy.types.PropertyGroup) -> Callable[[str], Any]:
        """What gives a setting by its name: that of the operator where it is given, else the panel's."""
        return lambda name: getattr(self if self.properties.is_property_set(name) else panel, name)

    def given_file(self, what_to_do: str) -> Path:
        """The file that `filepath` names; `InputError`, with `what_to_do`, where it names none."""
        if not self.filepath:
            raise InputError(f"no file given: {what_to_do}")
        return storage.absolute(self.filepath)

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
            if is_running():
                raise InputError("another job is running: wait for it or cancel it")
            with reports.warnings_reported(self):
                job = self.job(context)
                text = run(job, StagedProgress(progress_bar, job.label))
            self.report({"INFO"}, text)
        except BaseException as error:
            return self._failed(error)
        return {"FINISHED"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Start the job in a thread, or let it wait for those before it; without a window, do it at once."""
        if bpy.app.background or context.window is None:
            return self.execute(context)
        try:
            asked = None if self.confirmed else self.ask(context)
            if asked is not None:
                self._asked = True
                return asked
            with reports.warnings_reported(self):
                job = self.job(context)
        except Exception as error:
            return self._failed(error)
        self._enqueue(job)
        self._tick(context, _INTERVAL)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Begin when it is this job's turn, watch the thread, and when that is done, finish step by step."""
        job, worker = self._job, self._run
        if job is None or worker is None or (worker is not _current and worker not in _waiting):  # stopped from outside
            self.cancel(context)
            return {"CANCELLED"}
        if event.type == "ESC" and event.value == "PRESS" and worker is _current:
            bpy.ops.mphdrr.cancel_job("INVOKE_DEFAULT")
            return {"RUNNING_MODAL"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        if worker in _waiting and not worker.cancel.is_set():
            self._begin_if_first()
            return {"PASS_THROUGH"}
        is_drawing = time.monotonic() >= self._drawn + _INTERVAL
        if is_drawing:
            self._drawn = time.monotonic()
            _redraw(context)
        try:
            if worker.is_alive():
                job.look()
                return {"PASS_THROUGH"}
            if worker.steps is None:
                self._tick(context, _STEP)
                self._left = time.perf_counter()
                for text in worker.caught:
                    self.report({"WARNING"}, reports.in_window(text))
                if worker.error is not None or worker.cancel.is_set():
                    raise worker.error or Cancelled()
                worker.steps = _finishing(job, worker.result)
                worker.result = None
            # Drawing is work, too. A window that is drawn slowly has few turns, and does more in each.
            since = time.perf_counter() - self._left
            enough = time.perf_counter() + max(0.0 if is_drawing else _STEP, min(_SHARE * since, _MOST))
            with reports.warnings_reported(self):  # type: ignore[arg-type]
                while True:
                    step = worker.steps.throw(Cancelled()) if worker.is_stoppable else next(worker.steps)
                    worker.show_step(step)
                    if time.perf_counter() >= enough or (step is not None and step[1] == step[2]):
                        break
            self._left = time.perf_counter()
        except StopIteration as end:
            self._end(context)
            self.report({"INFO"}, end.value)
            return {"FINISHED"}
        except BaseException as error:
            worker.cancel.set()  # what was looked at cannot be shown: the thread has nothing to go on for
            self._end(context)
            job.discard()
            return self._failed(error)
        return {"PASS_THROUGH"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Blender ends the operator: its window closes, or another file is loaded."""
        if self._run is not None and self._run is _current:
            stop()
        self._end(context)
        if self._job is not None:
            self._job.discard()

    def _enqueue(self, job: Job) -> None:
        """Let a job begin when those that wait have."""
        self._job, self._run = job, Worker(job.label, job.work, job.enough)
        _waiting.append(self._run)
        self._begin_if_first()

    def _begin_if_first(self) -> None:
        """Start the thread where no job runs and none waits longer."""
        global _current
        if _current is None and self._run is _waiting[0]:
            _current = _waiting.pop(0)
            _current.start()

    def _start_after_asking(self) -> set[str]:
        """Blender calls `execute` after a dialog, which cannot become modal: start another operator of this kind."""
        given = {name: _argument(value) for name, value in self.as_keywords(ignore=("confirmed",)).items()}
        group, name = self.bl_idname.split("_OT_")  # an instance has the class's name there
        try:
            getattr(getattr(bpy.ops, group.lower()), name)("INVOKE_DEFAULT", confirmed=True, **given)
        except RuntimeError as error:  # what the other one reported
            self.report({"ERROR"}, str(error).removeprefix("Error: ").strip())
        return {"CANCELLED"}

    def _tick(self, context: bpy.types.Context, interval: float | None) -> None:
        """Have `modal` called every `interval` seconds from now on, or no more."""
        if self._timer is not None:
            context.window_manager.event_timer_remove(self._timer)
        self._timer = (
            None if interval is None else context.window_manager.event_timer_add(interval, window=context.window)
        )

    def _end(self, context: bpy.types.Context) -> None:
        global _current
        self._tick(context, None)
        if _current is self._run:
            _current = None
        elif self._run in _waiting:
            _waiting.remove(self._run)
        _redraw(context)

    def _failed(self, error: BaseException) -> set[str]:
        if not isinstance(error, Exception):
            raise error  # KeyboardInterrupt and the like
        level, text = "ERROR", reports.in_window(error)
        if isinstance(error, Cancelled):
            left = "nothing was changed" if self._job is None else self._job.left()
            level, text = "WARNING", f"{self.bl_label}: cancelled, {left}"
        elif isinstance(error, ReferenceError):  # a datablock that the job had made or found
            text = f"{self.bl_label}: stopped, since Undo has taken back what it works on; start it again"
        elif isinstance(error, MemoryError):
            text = f"{self.bl_label}: not enough memory; choose fewer voxels or pixels"
        elif not isinstance(error, InputError):
            traceback.print_exception(error)
            text = f"{self.bl_label} failed: {type(error).__name__}: {error} (details in the console)"
        self.report({level}, text)
        return {"CANCELLED"}


class ExportJob(JobOperator, ExportHelper):
    """Mix into an operator whose job writes the file that the user chooses, with one of the `endings` in its name."""

    bl_options: set[str] = set()
    endings: tuple[str, ...] = ()

    @property
    def filename_ext(self) -> str:
        """What Blender adds to the .blend's name."""
        return self.endings[0]

    def ask(self, context: bpy.types.Context) -> set[str] | None:
        """Open the file browser."""
        return ExportHelper.invoke(self, context, None)

    def check(self, context: bpy.types.Context) -> bool:
        """Give a name without one of the endings the first."""
        if self.filepath.lower().endswith(self.endings):
            return False
        self.filepath += self.endings[0]
        return True


class MPHDRR_OT_cancel_job(reports.Reported, bpy.types.Operator):
    """Stop a job, or take it out of the queue; the scene stays as it was. What can be kept of it is asked for first"""

    bl_label = "Cancel"
    bl_options = {"INTERNAL"}

    number: IntProperty(name="Job", description="Its number; 0: the running one", options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask whether to keep or to discard what the running job has made, if it can be kept."""
        worker = _current
        if worker is None or worker.enough is None or self.number not in (0, worker.number):
            return self.execute(context)

        def draw(menu: Any, context: bpy.types.Context) -> None:
            menu.layout.operator("mphdrr.finish_job", text="Keep What There Is", icon="CHECKMARK")
            menu.layout.operator_context = "EXEC_DEFAULT"
            menu.layout.operator("mphdrr.cancel_job", text="Discard", icon="TRASH").number = worker.number

        context.window_manager.popup_menu(draw, title=f"{worker.label}: Stop?", icon="QUESTION")
        return {"CANCELLED"}

    def act(self, context: bpy.types.Context) -> None:
        """Ask it to stop at its next step."""
        for worker in filter(None, (_current, *_waiting)):
            if self.number == worker.number or (self.number == 0 and worker is _current):
                worker.cancel.set()


class MPHDRR_OT_finish_job(reports.Reported, bpy.types.Operator):
    """End the running job after the step that it is at, and keep what it has made so far"""

    bl_label = "Finish Now"
    bl_options = {"INTERNAL"}

    def act(self, context: bpy.types.Context) -> None:
        """Ask it to come to its end."""
        if _current is not None and _current.enough is not None:
            _current.enough.set()


def draw_job(layout: bpy.types.UILayout) -> None:
    """Draw the running job's stage and those that wait, each with its Cancel button; nothing where there is none."""
    for worker in filter(None, (_current, *_waiting)):
        row = layout.row(align=True)
        row.operator_context = "INVOKE_DEFAULT"
        if worker is _current:
            row.progress(factor=worker.share, type="BAR", text=worker.text)
            if worker.enough is not None:
                row.operator("mphdrr.finish_job", text="", icon="CHECKMARK")
        else:
            row.label(text=iface("{job}: waits").format(job=iface(worker.label)), translate=False, icon="TIME")
        row.operator("mphdrr.cancel_job", text="", icon="CANCEL").number = worker.number


def draw_status(header: bpy.types.Header, context: bpy.types.Context) -> None:
    """Draw the running job in Blender's status bar."""
    if _current is not None:
        row = header.layout.row(align=True)
        row.ui_units_x, row.operator_context = _STATUS_UNITS, "INVOKE_DEFAULT"
        row.progress(factor=_current.share, type="BAR", text="mphDRR: " + _current.text)
        row.operator("mphdrr.cancel_job", text="", icon="CANCEL").number = _current.number


def _argument(value: Any) -> Any:
    """An operator's setting, as another operator takes it."""
    if isinstance(value, bpy.types.bpy_prop_array):
        return tuple(value)
    if isinstance(value, bpy.types.bpy_prop_collection):  # of files
        return [{"name": item.name} for item in value]
    return value


def _redraw(context: bpy.types.Context) -> None:
    """Have sidebars and status bars drawn: ten times a second."""
    for window in context.window_manager.windows:
        with bpy.context.temp_override(window=window):
            window.workspace.status_text_set(None)  # there is no other way to have the status bar drawn
    windows.redraw_sidebars()
