"""LibreOffice, if it is installed: an independent calculator of whole workbooks."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import tempfile
from pathlib import Path

TIME_LIMIT = 120.0
"""Seconds."""

_USUAL_PLACES = (
    "/Applications/LibreOffice.app/Contents/MacOS/soffice",
    r"C:\Program Files\LibreOffice\program\soffice.exe",
    r"C:\Program Files (x86)\LibreOffice\program\soffice.exe",
)
# Recalculate every formula of a loaded file: by default only those of files by other programs that have no value.
_SETTINGS = """<?xml version="1.0" encoding="UTF-8"?>
<oor:items xmlns:oor="http://openoffice.org/2001/registry">
<item oor:path="/org.openoffice.Office.Calc/Formula/Load"><prop oor:name="OOXMLRecalcMode" oor:op="fuse">\
<value>0</value></prop></item>
</oor:items>
"""


def program() -> str | None:
    """Return the path of LibreOffice, None if it is not installed."""
    found = shutil.which("soffice") or shutil.which("libreoffice")
    return found or next((path for path in _USUAL_PLACES if os.path.exists(path)), None)


def recalculated(workbooks: list[bytes], suffix: str = ".xlsx", time_limit: float = TIME_LIMIT) -> list[bytes | None]:
    """Return the workbooks (files' bytes) as LibreOffice saves them after calculating all their formulas.

    None for a workbook that LibreOffice did not save: it is not installed, failed, or took too long. It runs
    without a window, in a temporary folder with a profile of its own, and no macro runs.
    """
    office = program()
    if office is None or not workbooks:
        return [None] * len(workbooks)
    with tempfile.TemporaryDirectory(prefix="mphdrr-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        settings = folder / "profile" / "user"
        settings.mkdir(parents=True)
        (settings / "registrymodifications.xcu").write_text(_SETTINGS, encoding="utf-8")
        given = [folder / f"{i}{suffix}" for i in range(len(workbooks))]
        for path, content in zip(given, workbooks, strict=True):
            path.write_bytes(content)
        _run(
            [
                office,
                f"-env:UserInstallation={(folder / 'profile').as_uri()}",
                *("--headless", "--norestore", "--convert-to", "xlsx:Calc MS Excel 2007 XML"),
                *("--outdir", str(folder / "out")),
                *map(str, given),
            ],
            time_limit,
        )
        saved = [folder / "out" / f"{path.stem}.xlsx" for path in given]
        return [path.read_bytes() if path.is_file() else None for path in saved]


def _run(command: list[str], time_limit: float) -> None:
    quiet = subprocess.DEVNULL
    try:
        # Its own session, so that the processes that soffice starts end with it.
        process = subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True)
    except OSError:
        return
    try:
        process.wait(time_limit)
    except subprocess.TimeoutExpired:
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        process.kill()
        process.wait()
