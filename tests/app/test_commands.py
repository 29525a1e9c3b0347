"""``blender --command mphdrr`` and the batch example, in the application."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
WORKBOOK = ROOT / "examples" / "dc-spect-80.xlsx"
RECIPE = f"""
version = 1
system = {{ file = {str(WORKBOOK)!r}, modules = "1-4" }}
detector = {{ rows = 16, columns = 16 }}
truth = {{ voxels = 16, spacing = 6.0 }}
models = {{ lines = {{ kind = "transmission" }} }}
phantoms = [{{ kind = "points", diameter = {{ from = 6, to = 12 }} }}]
"""
SMALL = ("--voxels", "32", "--spacing", "3", "--size", "24", "32")


def test_the_main_path_runs_by_commands(blender, work_folder):
    said = blender("--command", "mphdrr", "geometry", "check", WORKBOOK)
    assert "20 + 20 + 20 + 20" in said.stdout

    phantom, run, blend = (work_folder / name for name in ("derenzo.npz", "run.h5", "scanner.blend"))
    blender("--command", "mphdrr", "phantom", "derenzo", *SMALL[:4], "-o", phantom)
    blender("--command", "mphdrr", "project", WORKBOOK, "--volume", phantom, *SMALL[4:], "-o", run)
    blender("--command", "mphdrr", "export", run, "-o", work_folder / "run.npz")
    blender("--command", "mphdrr", "scene", WORKBOOK, "--run", run, "-o", blend)
    for path in (phantom, run, work_folder / "run.npz", blend):
        assert path.stat().st_size > 0, path

    from mphdrr.core import read_run

    assert read_run(run).projections.shape == (80, 24, 32)


def test_command_errors_are_one_line_and_status_1(blender, work_folder):
    said = blender("--command", "mphdrr", "geometry", "show", work_folder / "none.xlsx", check=False)
    assert said.returncode == 1
    assert [line for line in said.stderr.splitlines() if "none.xlsx" in line and line.startswith("mphdrr: ")]
    assert "Traceback" not in said.stderr


def test_the_batch_example_runs_in_background(blender, work_folder):
    example = ROOT / "examples" / "batch.py"
    said = blender("--background", "--python-exit-code", "3", "--python", example, "--", WORKBOOK, work_folder / "out")
    assert {path.name for path in (work_folder / "out").iterdir()} >= {"run.npz", "scanner.blend", "scanner_mphdrr"}
    assert "Traceback" not in said.stderr


def test_a_saved_scene_opens_and_projects_again(blender, blender_script, work_folder):
    blend = work_folder / "scanner.blend"
    blender("--command", "mphdrr", "phantom", "derenzo", *SMALL[:4], "-o", work_folder / "derenzo.npz")
    blender("--command", "mphdrr", "scene", WORKBOOK, "--volume", work_folder / "derenzo.npz", "-o", blend)
    said = blender_script(
        """
import sys, bpy
bpy.ops.wm.open_mainfile(filepath=sys.argv[sys.argv.index("--") + 1])
assert bpy.ops.mphdrr.render_projections(width=16, height=16, first=1, last=3) == {"FINISHED"}
assert len([i for i in bpy.data.images if i.is_float and i.size[0] == 16]) == 3
print("PROJECTED")
""",
        blend,
    )
    assert "PROJECTED" in said.stdout


def test_event_sets_are_made_by_command(blender, work_folder):
    recipe, made = work_folder / "small.toml", work_folder / "set"
    recipe.write_text(RECIPE, encoding="utf-8")
    command = ("--command", "mphdrr", "events", "make", made, "--recipe", recipe, "-n", "3")
    said = blender(*command, "--workers", "2", check=False)
    assert said.returncode == 1 and "Traceback" not in said.stderr
    assert "mphdrr: workers: expected 1 within Blender" in said.stderr
    blender(*command)
    said = blender("--command", "mphdrr", "events", "check", made)
    assert "3 events, every byte as it was written" in said.stdout
