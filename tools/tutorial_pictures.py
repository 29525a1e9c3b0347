"""Write pictures that tests in tests/app have taken: the tutorial's (`make tutorial`), or docs/images/xray-blender.webp.

pytest tests/app -k six_clicks && python tools/tutorial_pictures.py xray
"""

import sys
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
TAKEN = ROOT / "out" / "test-app" / "test_tutorial"
FOLDER = ROOT / "docs" / "images" / "tutorial"
WIDTH = 1280  # pixels
CLICKS = ROOT / "out" / "test-app" / "test_six_clicks_lead_from_an_empty_scene_over_a_ct_to_a_dose_map"


def clicks() -> None:
    """Write four of the six clicks to a dose map, on one page."""
    shown = (0, 28, 1313, 905)  # without menus and what stands beside the two editors
    taken = [Image.open(CLICKS / f"click-{number}.png").convert("RGB").crop(shown) for number in (1, 2, 4, 5)]
    width, height = (round(0.7 * side) for side in taken[0].size)
    page = Image.new("RGB", (2 * width + 8, 2 * height + 8), (24, 26, 29))
    for i, picture in enumerate(taken):
        small = picture.resize((width, height), Image.Resampling.LANCZOS)
        page.paste(small, (i % 2 * (width + 8), i // 2 * (height + 8)))
    page.save(ROOT / "docs" / "images" / "xray-blender.webp", quality=80, method=6)


def main() -> None:
    """Write the tutorial's pictures anew."""
    FOLDER.mkdir(exist_ok=True)
    for old in FOLDER.iterdir():
        old.unlink()
    for path in sorted(TAKEN.glob("*.png")):
        if path.stem != "window":  # which the fixture takes of every window
            picture = Image.open(path).convert("RGB")
            file = FOLDER / f"{path.stem}.webp"
            picture.resize((WIDTH, WIDTH * picture.height // picture.width), Image.Resampling.LANCZOS).save(
                file, quality=80, method=6
            )
            print(f"{file.relative_to(ROOT)}: {file.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    clicks() if sys.argv[1:] == ["xray"] else main()
