"""Long jobs that leave the window alive: a worker thread computes, a modal operator watches it.

A function of `addon` returns a `Job`; an operator that inherits from `JobOperator` does it. Started from the window
(INVOKE), it runs in a worker thread, after those started earlier, until Esc or a button cancels it. Called from a script
(EXEC) or without a window, the operator returns when the job is done. Scripts can also call `run`.
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

from ...core.cli.options import duration_text, progress_bar
from ...core.errors import InputError
from ...core.progress import Cancelled, Progress, StagedProgress
from ...core.recording import recorded_warnings
from . import reports, storage, windows

_INTERVAL = 0.1  # s between two checks of the worker thread, and between two drawings of its progress
_STEP_TIME = 0.02  # s of the main thread for finishing a job, after which the window gets its turn of the same length
# Where the window is drawn slowly, finishing may take this fraction of the time since the last step, at most so many s.
_SLOW_SHARE, _MAX_STEP_TIME = 0.1, 0.05
_STOP_TIMEOUT = 0.2  # s that `stop` waits for a worker thread; a slower one ends by itself, and its result is dropped
_STATUS_UNITS = 16  # the job's width in the status bar
_ESTIMATE_AFTER = 1.0  # s of a stage after which the remaining time is estimated

Finishing = Generator[tuple[str, int, int] | None, None, str]
"""Steps of the main thread that finish a job, between which the window is drawn; returns the line to report.

A step at which the job can be cancelled yields (stage, done, total), any other step None. Where the user cancels, that
yield raises `Cancelled`, and the generator takes back its changes. Where done = total, the window also gets its turn.
"""


@dataclass
class Job:
    """Work for a worker thread, and the functions of the main thread that go with it."""

    label: str
    work: Callable[[Progress], Any]
    """Computation in the worker thread, without bpy; ``progress(done, total)`` raises `Cancelled` when the user cancels."""
    finish: Callable[[Any], str | Finishing]
    """Use of the work's result in the main thread; returns the line to report, or is a generator if it takes long."""
    discard: Callable[[], None] = lambda: None
    """Removal of the work's files and of what `refresh` has shown, where the job ends before it has finished."""
    refresh: Callable[[], None] = lambda: None
    """Display of intermediate results, called in the main thread ten times a second while the work runs."""
    finish_now: threading.Event | None = None
    """Event set by the button Finish Now, at which the work ends early as if it were done."""
    leftovers: Callable[[], str] = lambda: "nothing was changed"
    """Description of what the job leaves behind where the user has cancelled it."""


def run(job: Job, progress: Progress = lambda done, total: None) -> str:
    """Do a job in the main thread and return the line to report; raise what the work raises."""
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
    """Yield the steps of `job.finish`, of which there may be none, and return its line to report."""
    text_or_steps = job.finish(result)
    return (yield from text_or_steps) if isinstance(text_or_steps, Generator) else text_or_steps


def require_scene(uid: int, purpose: str) -> bpy.types.Scene:
    """Return the scene with this `session_uid`; `InputError` where it is gone, with `purpose` such as "the design is"."""
    if (scene := find_by_uid(bpy.data.scenes, uid)) is None:
        raise InputError(f"the scene that {purpose} for is gone")
    return scene


def find_by_uid(datablocks: Any, uid: int) -> Any:
    """Return the datablock with this `session_uid`, whatever its name is now; None where it is gone."""
    return next((item for item in datablocks if item.session_uid == uid), None)


class Worker(threading.Thread):
    """Worker thread of a job: its stage and progress, its warnings and result, and the steps that finish the job."""

    _numbers = itertools.count(1)

    def __init__(self, label: str, work: Callable[[Progress], Any], finish_now: threading.Event | None = None) -> None:
        super().__init__(name=f"mphDRR: {label}", daemon=True)
        self.label, self.work, self.number, self.finish_now = label, work, next(self._numbers), finish_now
        self.stage, self.stage_start = label, time.monotonic()
        self.done = self.total = 0
        self.result: Any = None
        self.error: BaseException | None = None
        self.warnings: list[str] = []
        self.cancel = threading.Event()
        self.steps: Finishing | None = None
        self._can_stop = self.is_asked_about = False

    def run(self) -> None:
        """Do the work and keep its result or its error, with the warnings."""
        with recorded_warnings() as self.warnings:
            try:
                self.result = self.work(StagedProgress(self._begin, self.label))
            except BaseException as error:
                self.error = error

    @property
    def share(self) -> float:
        """Completed fraction of the stage, 0 to 1."""
        return min(1.0, self.done / max(1, self.total))

    @property
    def text(self) -> str:
        """The stage in words, with its progress and the time that it has taken or still takes; short, for a sidebar."""
        stage_text, elapsed = self.stage[:1].upper() + self.stage[1:], time.monotonic() - self.stage_start
        if self.cancel.is_set():
            return f"{stage_text}: stopping"
        if self.total < 2:
            return f"{stage_text}, {elapsed:.0f} s" if elapsed > _ESTIMATE_AFTER else stage_text
        stage_text += f" {self.done} of {self.total}" if self.total < 100 else f" {100 * self.share:.0f} %"
        if elapsed < _ESTIMATE_AFTER or not 0 < self.done < self.total:
            return stage_text
        remaining = elapsed / self.done * (self.total - self.done)
        return f"{stage_text}, {duration_text(remaining)} left"

    @property
    def is_stoppable(self) -> bool:
        """Whether the user has cancelled the job and finishing can stop after its last step."""
        return self.cancel.is_set() and self._can_stop

    def show_step(self, step: tuple[str, int, int] | None) -> None:
        """Note a step of finishing."""
        self._can_stop = step is not None
        if step is not None:
            self.show(*step)

    def show(self, stage: str, done: int, total: int) -> None:
        """Note the progress of a stage."""
        if stage != self.stage:
            self.stage, self.stage_start = stage, time.monotonic()
        self.done, self.total = done, total

    def _begin(self, stage: str) -> Progress:
        """Begin a stage and return its progress function, which raises `Cancelled` once the job is cancelled."""

        def progress(done: int, total: int) -> None:
            """Show the progress of the stage, and stop the job where it was cancelled."""
            self.show(stage, done, total)
            if self.cancel.is_set():
                raise Cancelled

        self.stage_start = time.monotonic()
        progress(0, 0)
        return progress


_current: Worker | None = None
_waiting: list[Worker] = []


def is_running() -> bool:
    """Return whether a job runs in a worker thread or waits for its turn."""
    return _current is not None or bool(_waiting)


def stop(*_: Any) -> None:
    """Cancel all jobs and wait a moment for the worker thread, before a file is loaded or the extension is disabled."""
    global _current
    worker, _current = _current, None
    _waiting.clear()
    if worker is not None:
        worker.cancel.set()
        worker.join(_STOP_TIMEOUT)
        if worker.steps is not None:
            worker.steps.close()


class JobOperator:
    """Mix-in of an operator whose method `job` returns its job; `asks_for` or `dialog` lets it ask the user first."""

    bl_options = {"REGISTER", "UNDO"}

    confirmed: BoolProperty(name="Confirmed", description="Start without asking", options={"HIDDEN", "SKIP_SAVE"})

    asks_for = ""
    """The property that the user sets in a file browser, unless it is set already, as by dropping a file on the window."""
    dialog: dict[str, Any] | None = None
    """Arguments of a dialog of the operator's properties: `confirm_text` on its button, `width`; None for no dialog."""

    _has_asked = False
    _job: Job | None = None
    _run: Worker | None = None
    _timer: bpy.types.Timer | None = None
    _drawn = _last_step = 0.0

    if TYPE_CHECKING:  # members of every bpy.types.Operator
        bl_idname: str
        bl_label: str
        properties: Any
        filepath: str  # only of an operator that reads or writes a file
        report: Callable[[set[str], str], None]
        as_keywords: Callable[..., dict[str, Any]]

    def job(self, context: bpy.types.Context) -> Job:
        """Return the job, from the operator's and the scene's settings, or raise `InputError`."""
        raise NotImplementedError

    def setting_values(self, panel: bpy.types.PropertyGroup, *names: str) -> list[Any]:
        """Return the values of settings: the operator's where set explicitly, else the panel's."""
        return list(map(self.setting_getter(panel), names))

    def setting_getter(self, panel: bpy.types.PropertyGroup) -> Callable[[str], Any]:
        """Return a getter of settings by name: the operator's property if set explicitly, else the panel's."""
        return lambda name: getattr(self if self.properties.is_property_set(name) else panel, name)

    def required_file(self, advice: str) -> Path:
        """Return the path in `filepath`; raise `InputError` with `advice` where it is empty."""
        if not self.filepath:
            raise InputError(f"no file given: {advice}")
        return storage.absolute(self.filepath)

    def ask(self, context: bpy.types.Context) -> set[str] | None:
        """Open a dialog or a file browser whose button starts the job; return None where the operator asks nothing."""
        if self.dialog is not None:
            return context.window_manager.invoke_props_dialog(self, title=self.bl_label, **self.dialog)
        if not self.asks_for or getattr(self, self.asks_for):
            return None
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Do the job at once and return when it is done."""
        if self._has_asked:
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
        """Start the job in a worker thread, or queue it behind earlier ones; without a window, do it at once."""
        if bpy.app.background or context.window is None:
            return self.execute(context)
        try:
            result = None if self.confirmed else self.ask(context)
            if result is not None:
                self._has_asked = True
                return result
            with reports.warnings_reported(self):
                job = self.job(context)
        except Exception as error:
            return self._failed(error)
        self._enqueue(job)
        self._tick(context, _INTERVAL)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Start the job when its turn comes, watch the worker thread, then finish the job step by step."""
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
                job.refresh()
                return {"PASS_THROUGH"}
            if worker.steps is None:
                self._tick(context, _STEP_TIME)
                self._last_step = time.perf_counter()
                for text in worker.warnings:
                    self.report({"WARNING"}, reports.in_window(text))
                if worker.error is not None or worker.cancel.is_set():
                    raise worker.error or Cancelled()
                worker.steps = _finishing(job, worker.result)
                worker.result = None
            # Drawing takes time, too: a window that is drawn slowly has few turns, so each turn may take longer.
            slow = min(_SLOW_SHARE * (time.perf_counter() - self._last_step), _MAX_STEP_TIME)
            deadline = time.perf_counter() + max(0.0 if is_drawing else _STEP_TIME, slow)
            with reports.warnings_reported(self):  # type: ignore[arg-type]
                while True:
                    step = worker.steps.throw(Cancelled()) if worker.is_stoppable else next(worker.steps)
                    worker.show_step(step)
                    if time.perf_counter() >= deadline or (step is not None and step[1] == step[2]):
                        break
            self._last_step = time.perf_counter()
        except StopIteration as end:
            self._end(context)
            self.report({"INFO"}, end.value)
            return {"FINISHED"}
        except BaseException as error:
            worker.cancel.set()  # `refresh` may have failed while the thread still runs: its result is of no use
            self._end(context)
            job.discard()
            return self._failed(error)
        return {"PASS_THROUGH"}

    def cancel(self, context: bpy.types.Context) -> None:
        """Stop the job where Blender ends the operator: its window closes, or another file is loaded."""
        if self._run is not None and self._run is _current:
            stop()
        self._end(context)
        if self._job is not None:
            self._job.discard()

    def _enqueue(self, job: Job) -> None:
        """Queue a job behind the waiting ones, and start it if there are none."""
        self._job, self._run = job, Worker(job.label, job.work, job.finish_now)
        _waiting.append(self._run)
        self._begin_if_first()

    def _begin_if_first(self) -> None:
        """Start the worker thread if no job runs and none has waited longer."""
        global _current
        if _current is None and self._run is _waiting[0]:
            _current = _waiting.pop(0)
            _current.start()

    def _start_after_asking(self) -> set[str]:
        """Start another operator of this class: Blender calls `execute` after a dialog, which cannot become modal."""
        keywords = {name: _argument(value) for name, value in self.as_keywords(ignore=("confirmed",)).items()}
        group, name = self.bl_idname.split("_OT_")  # an instance's `bl_idname` is its class's name
        try:
            getattr(getattr(bpy.ops, group.lower()), name)("INVOKE_DEFAULT", confirmed=True, **keywords)
        except RuntimeError as error:  # the other operator's report
            self.report({"ERROR"}, str(error).removeprefix("Error: ").strip())
        return {"CANCELLED"}

    def _tick(self, context: bpy.types.Context, interval: float | None) -> None:
        """Have `modal` called every `interval` seconds from now on; None: not any more."""
        manager = context.window_manager
        if self._timer is not None:
            manager.event_timer_remove(self._timer)
        self._timer = None if interval is None else manager.event_timer_add(interval, window=context.window)

    def _end(self, context: bpy.types.Context) -> None:
        """Stop watching the job and let the next one begin."""
        global _current
        self._tick(context, None)
        if _current is self._run:
            _current = None
        elif self._run in _waiting:
            _waiting.remove(self._run)
        for window in context.window_manager.windows if self._run and self._run.is_asked_about else ():
            window.screen = window.screen  # closes menus: Blender does so where a window gets a screen, even its own
        _redraw(context)

    def _failed(self, error: BaseException) -> set[str]:
        """Report an error in plain words, as a warning if the user has cancelled the job."""
        if not isinstance(error, Exception):
            raise error  # KeyboardInterrupt and the like
        level, text = "ERROR", reports.in_window(error)
        if isinstance(error, Cancelled):
            leftovers = "nothing was changed" if self._job is None else self._job.leftovers()
            level, text = "WARNING", f"{self.bl_label}: cancelled, {leftovers}"
        elif isinstance(error, ReferenceError):  # Undo has removed a datablock of the job
            text = f"{self.bl_label}: stopped, since Undo has taken back what it works on; start it again"
        elif isinstance(error, MemoryError):
            text = f"{self.bl_label}: not enough memory; choose fewer voxels or pixels"
        elif not isinstance(error, InputError):
            traceback.print_exception(error)
            text = f"{self.bl_label} failed: {type(error).__name__}: {error} (details in the console)"
        self.report({level}, text)
        return {"CANCELLED"}


class ExportJob(JobOperator, ExportHelper):
    """Mix-in of an operator whose job writes the file that the user chooses; its name ends with one of `endings`."""

    bl_options: set[str] = set()
    endings: tuple[str, ...] = ()

    @property
    def filename_ext(self) -> str:
        """The ending that Blender adds to the .blend's name."""
        return self.endings[0]

    def ask(self, context: bpy.types.Context) -> set[str] | None:
        """Open the file browser."""
        return ExportHelper.invoke(self, context, None)

    def check(self, context: bpy.types.Context) -> bool:
        """Append the first of `endings` to a name without one, and return whether the name has changed."""
        if self.filepath.lower().endswith(self.endings):
            return False
        self.filepath += self.endings[0]
        return True


class MPHDRR_OT_cancel_job(reports.Reported, bpy.types.Operator):
    """Stop a job, or take it out of the queue; the scene stays as it was. If its results so far can be kept, ask first."""

    bl_label = "Cancel"
    bl_options = {"INTERNAL"}

    number: IntProperty(name="Job", description="Number; 0: the running job", options={"HIDDEN", "SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask whether to keep or to discard the running job's results so far, if they can be kept."""
        worker = _current
        if worker is None or worker.finish_now is None or self.number not in (0, worker.number):
            return self.execute(context)

        def draw(menu: Any, context: bpy.types.Context) -> None:
            menu.layout.operator("mphdrr.finish_job", text="Keep What There Is", icon="CHECKMARK")
            menu.layout.operator_context = "EXEC_DEFAULT"
            menu.layout.operator("mphdrr.cancel_job", text="Discard", icon="TRASH").number = worker.number

        context.window_manager.popup_menu(draw, title=f"{worker.label}: Stop?", icon="QUESTION")
        worker.is_asked_about = True
        return {"CANCELLED"}

    def act(self, context: bpy.types.Context) -> None:
        """Ask the job to stop at its next step."""
        for worker in filter(None, (_current, *_waiting)):
            if self.number == worker.number or (self.number == 0 and worker is _current):
                worker.cancel.set()


class MPHDRR_OT_finish_job(reports.Reported, bpy.types.Operator):
    """End the running job after its present step, and keep its results so far."""

    bl_label = "Finish Now"
    bl_options = {"INTERNAL"}

    def act(self, context: bpy.types.Context) -> None:
        """Ask the running job to end early."""
        if _current is not None and _current.finish_now is not None:
            _current.finish_now.set()


def draw_job(layout: bpy.types.UILayout) -> None:
    """Draw the running job's stage and the waiting jobs, each with its Cancel button."""
    for worker in filter(None, (_current, *_waiting)):
        row = layout.row(align=True)
        row.operator_context = "INVOKE_DEFAULT"
        if worker is _current:
            row.progress(factor=worker.share, type="BAR", text=worker.text)
            if worker.finish_now is not None:
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
    """Return the value of an operator's property as a keyword argument of another operator."""
    if isinstance(value, bpy.types.bpy_prop_array):
        return tuple(value)
    if isinstance(value, bpy.types.bpy_prop_collection):  # files
        return [{"name": item.name} for item in value]
    return value


def _redraw(context: bpy.types.Context) -> None:
    """Have sidebars and status bars drawn again."""
    for window in context.window_manager.windows:
        with bpy.context.temp_override(window=window):
            window.workspace.status_text_set(None)  # there is no other way to have the status bar drawn
    windows.redraw_sidebars()
