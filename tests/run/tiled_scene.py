"""What tests of scenes in tiles share."""

from hashlib import sha256

from lommel.run.inputs import SceneFiles

POSTS, SIDE = 320, 128  # nine tiles, the halos of most of which end inside the scene


def files_of(folder):
    return SceneFiles(
        tuple(sorted(folder.glob("img*.tif"))),
        (folder / "init_dem.tif",),
        folder / "sun_positions.txt",
    )


def fingerprints(folder):
    return {p.name: sha256(p.read_bytes()).hexdigest() for p in folder.glob("*.tif")}
