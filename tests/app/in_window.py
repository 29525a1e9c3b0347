"""Run a script in a Blender with its window on a virtual screen; capture the screen once it is done, or when time is up.

Arguments: the PNG to write, the script, the seconds that it may take, the folder in which it says how it went, and its own
arguments. It is done when a JSON file in that folder has "error", or a true "ok"; log.txt there is what Blender printed.
Runs on the real Blender's own Python.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

SCREEN = 1600, 1000
_SHOWN = 0.5  # s until the screen has what the script has drawn at last


def is_done(folder: Path) -> bool:
    """Return whether the script says that it has ended."""
    for path in folder.rglob("*.json"):
        try:
            said = json.loads(path.read_text())
        except ValueError:  # it is being written
            continue
        if "error" in said or said.get("ok"):
            return True
    return False


def main(picture: str, script: str, seconds: str, folder: str, *arguments: str) -> None:
    """Run a script in Blender's window, on a screen of its own."""
    width, height = SCREEN
    reading, writing = os.pipe()
    screen = subprocess.Popen(
        ["Xvfb", "-displayfd", str(writing), "-screen", "0", f"{width}x{height}x24"],
        pass_fds=[writing], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    os.close(writing)
    with os.fdopen(reading) as number:
        os.environ["DISPLAY"] = f":{number.readline().strip()}"
    place = ["--window-geometry", "0", "0", str(width), str(height)]
    place += [
        "--python-expr",
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})",
    ]  # for what scripts import
    with open(Path(folder, "log.txt"), "w") as log:
        blender = subprocess.Popen(["blender", *place, "--python", script, "--", *arguments], stdout=log, stderr=log)
    end = time.monotonic() + float(seconds)
    while time.monotonic() < end and blender.poll() is None and not is_done(Path(folder)):
        time.sleep(0.3)
    time.sleep(_SHOWN)
    subprocess.run(["import", "-window", "root", picture], check=True)
    for process in (blender, screen):
        process.kill()
        process.wait()


main(*sys.argv[1:])
