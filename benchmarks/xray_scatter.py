"""Ratio of scatter to primary behind water cylinders, and its time: ``python -m benchmarks.xray_scatter``.

Tubes stand 1000 mm from the axis, panels of 400 x 300 mm, with 0.6 mm of CsI, 500 mm behind it. Cylinders are 300 mm long.
"""

import time

import numpy as np

import mphdrr.core as mph

GRID = mph.Grid.centered((64, 64, 60), 5.0)
RADII = np.hypot(*(np.indices(GRID.shape)[:2] - 31.5)) * 5.0


def main():
    """Print the table."""
    print("| water, mm | kV | middle | 150 mm beside, on the panel | one collision | precision | histories | s |")
    print("|---|---|---|---|---|---|---|---|")
    for diameter in (200, 300):
        body = mph.Volume(np.where(diameter / 2 > RADII, 0.0, -1000.0).astype(np.float32), GRID, "hu")
        for kvp in (80, 120):
            x = mph.XraySystem([[0, -1000, 0]], [[0, 500, 0]], [[5, 0, 0]], [[0, 0, -5]], (60, 80), kvp, 1, {"Al": 2.5})
            model = mph.SpectralScan(x, panel="energy", sensor="CsI", sensor_thickness=0.6)
            views = x.views()
            begin = time.perf_counter()
            scatter = mph.xray_scatter(body, views, model, orders=2, threads=1)
            seconds = time.perf_counter() - begin
            primary = model.counts(model.at_ct_energy(body, None), mph.Projector(GRID, views, model))
            ratio = (scatter.images / primary)[0]
            middle, beside = ratio[27:33, 37:43].mean(), ratio[27:33, [7, 8, 9, 10, 69, 70, 71, 72]].mean()
            first = scatter.by_order[0, 0].sum() / scatter.images.sum()
            numbers = f"{middle:.2f} | {beside:.2f} | {100 * first:.0f} %"
            print(
                f"| {diameter} | {kvp} | {numbers} | {scatter.precision[0]:.4f} | {scatter.histories} | {seconds:.1f} |"
            )


if __name__ == "__main__":
    main()
