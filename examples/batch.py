"""Make workbook, phantom, projections and dataset in Blender without a window.

    blender --background --python examples/batch.py -- scanner.xlsx folder

With Blender's Python package instead of the application: python examples/batch.py scanner.xlsx folder
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import bpy

if not hasattr(bpy.types.Scene, "mphdrr_projections"):  # Blender's Python package has no extensions enabled
    import mphdrr

    mphdrr.register()

arguments = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
workbook = Path(arguments[0]) if arguments else Path(__file__).parent / "dc-spect-80.xlsx"
folder = Path(arguments[1] if len(arguments) > 1 else "out/batch").absolute()
folder.mkdir(parents=True, exist_ok=True)

bpy.ops.wm.read_homefile(use_empty=True)
bpy.ops.mphdrr.import_geometry(filepath=str(workbook.absolute()))
bpy.ops.mphdrr.add_derenzo(radius=40, rod_diameters=(8, 6, 5, 4, 3, 2), height=40, theta=math.radians(55), voxels=128)
bpy.ops.wm.save_as_mainfile(filepath=str(folder / "scanner.blend"))  # from now on large files are saved beside it

bpy.ops.mphdrr.render_projections(width=128, height=128)
bpy.ops.mphdrr.export_dataset(filepath=str(folder / "run.npz"))
bpy.ops.wm.save_mainfile()
print(f"{folder}: {', '.join(sorted(p.name for p in folder.iterdir()))}")
