"""Makes the pictures of the gallery: runs shipped scenes and draws sheets of their frames.

    python docs/gallery.py [SCENE ...]

Without names it takes all scenes. The pictures are small, because they are kept in the repository.
"""

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

import warpfem as wf
from warpfem.preview import preview
from warpfem.scene_file import load_scene

SCENES = Path(__file__).parent.parent / "scenes"
PICTURES = Path(__file__).parent / "gallery"
WIDTH, QUALITY = 1000, 85


def draw(scene: Path, folder: Path) -> Path:
    """Runs a scene and draws it; returns the path of the picture."""
    animation, sheet = folder / f"{scene.stem}.usdc", folder / f"{scene.stem}.png"
    print(wf.run(load_scene(scene), animation))
    preview(animation, sheet)
    picture = Image.open(sheet).convert("RGB")
    picture.thumbnail((WIDTH, WIDTH), Image.Resampling.LANCZOS)
    out = PICTURES / f"{scene.stem}.webp"
    picture.save(out, quality=QUALITY)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description="Makes the pictures of the gallery.")
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="names of shipped scenes (default: all)")
    names = parser.parse_args().scenes
    PICTURES.mkdir(exist_ok=True)
    with TemporaryDirectory() as folder:
        for scene in [SCENES / f"{name}.py" for name in names] or sorted(SCENES.glob("*.py")):
            print(draw(scene, Path(folder)))


if __name__ == "__main__":
    main()
