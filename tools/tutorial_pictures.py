"""Write the pictures that the tutorial's test in tests/app has taken as docs/images/tutorial: `make tutorial`."""

from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
TAKEN = ROOT / "out" / "test-app" / "test_tutorial"
FOLDER = ROOT / "docs" / "images" / "tutorial"
WIDTH = 1280  # pixels


def main() -> None:
    """Do so."""
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
    main()
