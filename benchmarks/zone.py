"""What the whole Apollo Zone would take: arithmetic from measured rates, printed as a table.

    python -m benchmarks.zone

Nothing is run. Tiles, strides and memory are those that the package plans for scenes of this size;
the rates were measured on simulated frames with simple cameras (docs/scaling.md,
docs/performance.md). The table stands in docs/scaling.md, and a test keeps both alike.
"""

from math import ceil, sqrt

from lommel.estimate.albedo_settings import AlbedoSettings
from lommel.run.albedo_plan import RAW_SECONDS, plan_albedo
from lommel.run.mixed_scene import Place, PlacedScene
from lommel.run.tiles_plan import Tiling, halo, make_plan
from lommel.scene.grid import Window, grid_from_bounds, read_crs

FRAMES, SIDE, SPACING = 4010, 20_000, 10.0  # pixels and posts along a frame; m
ROWS, COLS = 125_000, 545_000  # posts of the zone: 1250 km x 5450 km, 18 % of the Moon
REGION = 20_000  # posts along a region that one run of `lommel sfs` solves
CHOSEN = 8  # images of a place: of 24, 7 to 9 (docs/method.md, 3.6)
IN_TILE = 12  # of a tile of 4,352 posts, as frames begin and end in it: 8 (1 + 4352 / 20000)²
MEMORY = 8e9  # bytes of a worker
DISK_RATE = 200e6  # bytes per second of a shared disk, both ways
MARGIN = 4  # for real cameras, a cold disk, failures
WEEK = 7 * 86_400.0

# Core-seconds. Of 568 s on two cores for 4e8 posts and an image of 4.3e8 pixels, 37 prepared
ONE_IMAGE = 2 * (568 - 37) / 4e8  # per post, to solve with one image and write
PREPARE = 2 * 37 / 4.3e8  # per pixel: digest, samples, coarse stage; at most, it has the DEM in it
FURTHER = 0.25e-6  # per post of a tile and further image
ALBEDO = 2 * 386 / 1e9  # per pixel of 40 orthoimages of 5000 x 5000, all of the command
ANEW = 1.25  # workers compute samples in every pass
SCRATCH, PRODUCTS, OWN_PRODUCTS = 36, 25, 7  # bytes per post: tiles; products of sfs, of albedo


def table():
    """Rows of what, how and how much.

    Returns
    -------
    rows : list of tuple of str
    """
    posts, pixels = ROWS * COLS, FRAMES * SIDE**2
    deep = pixels / posts
    rows = [
        ("posts of the zone", f"{ROWS:,} × {COLS:,}", _count(posts)),
        ("pixels", f"{FRAMES:,} × {SIDE:,}²; {deep:.1f} images a place", _count(pixels)),
    ]
    shading, cores_shading = _shading(posts, pixels, deep)
    albedo, cores_albedo = _albedo(posts, pixels)
    hours = cores_shading + cores_albedo
    cores = ceil(MARGIN * hours * 3600 / WEEK)
    return [
        *rows,
        *shading,
        *albedo,
        ("**core-hours**", f"{cores_shading:.0f} + {cores_albedo:.0f}", f"**{hours:.0f}**"),
        ("cores for a week", f"{MARGIN} × {hours:.0f} h / 168 h", f"**{cores}**"),
    ]


def _shading(posts, pixels, deep):
    """Rows of `lommel sfs`, and its core-hours."""
    regions = ceil(ROWS / REGION) * ceil(COLS / REGION)
    touching = round(FRAMES * (SIDE + REGION) ** 2 / posts)
    plan = make_plan((REGION, REGION), touching, MEMORY, count=lambda window: IN_TILE)
    twice = plan.posts / REGION**2
    whole, coarse = touching * SIDE**2, deep * REGION**2
    tiles = CHOSEN * plan.posts
    read = regions * (whole + coarse + tiles)
    seconds = posts * (ONE_IMAGE + FURTHER * (CHOSEN - 1) * twice) + PREPARE * pixels
    side = sqrt(max(tile.outer.rows * tile.outer.cols for tile in plan.tiles))
    per_post = f"{1e6 * ONE_IMAGE:.2f} + {CHOSEN - 1} × 0.25 × {twice:.2f}"
    return [
        ("`sfs`: regions", f"of {REGION:,}² posts, {touching} images touch each", f"{regions}"),
        ("tiles of a region", f"of {side:,.0f}² posts, {IN_TILE} images", f"{len(plan.tiles)}"),
        ("posts solved twice", f"halos of {halo(plan.side)} posts", f"{100 * (twice - 1):.0f} %"),
        ("before them", "all images of a region at once", f"every {plan.stride}th post"),
        ("read for digests", f"{regions} × {touching} × {SIDE:,}²", _tb(regions * whole)),
        ("read for the coarse stage", f"{deep:.1f} images a post", _tb(regions * coarse)),
        ("read for tiles", f"{CHOSEN} images a post, with halos", _tb(regions * tiles)),
        ("read in all", f"{read / DISK_RATE / 3600:.0f} h of a disk of 200 MB/s", _tb(read)),
        ("written", f"{SCRATCH} bytes a post for a while, and products of {PRODUCTS}",
         _tb((SCRATCH + PRODUCTS) * posts)),
        ("core-hours: prepare", f"{1e6 * PREPARE:.2f} µs × {_count(pixels)} pixels",
         f"{PREPARE * pixels / 3600:.0f}"),
        ("core-hours: solve, write", f"({per_post}) µs × {_count(posts)} posts",
         f"{(seconds - PREPARE * pixels) / 3600:.0f}"),
    ], seconds / 3600  # fmt: skip


def _albedo(posts, pixels):
    """Rows of `lommel albedo`, and its core-hours."""
    plan = plan_albedo(zone_scene(), AlbedoSettings(), Tiling(MEMORY), is_shared=True)
    passes, waits = plan.passes, 4 * (pixels + posts)
    read, written = 2 * pixels + passes * waits, waits + (16 + 3.5 * OWN_PRODUCTS) * posts
    seconds = pixels * (ALBEDO * ANEW + RAW_SECONDS)
    many = f"{_count(pixels)} pixels"
    return [
        ("`albedo`: a worker of 8 GB", "one run for the whole zone",
         f"up to {plan.most_threads} threads"),
        ("disk while it runs", "images wait as 4 bytes a pixel", _tb(plan.disk)),
        ("read", f"images twice, then {passes} passes of 4 bytes", _tb(read)),
        ("read and written", f"{(read + written) / DISK_RATE / 3600:.0f} h of a disk of 200 MB/s",
         _tb(read + written)),
        ("core-hours: images onto the grid", f"{1e6 * RAW_SECONDS:.1f} µs × {many}",
         f"{pixels * RAW_SECONDS / 3600:.0f}"),
        ("core-hours: passes, maps", f"{1e6 * ALBEDO:.2f} µs × {ANEW} × {many}",
         f"{pixels * ALBEDO * ANEW / 3600:.0f}"),
    ], seconds / 3600  # fmt: skip


def zone_scene():
    """All frames on the grid of the zone, in even rows; without images.

    Returns
    -------
    placed : PlacedScene
    """
    crs = read_crs("+proj=eqc +R=1737400 +units=m +type=crs")
    bounds = 0.0, -SPACING * ROWS / 2, SPACING * COLS, SPACING * ROWS / 2
    grid = grid_from_bounds(bounds, SPACING, crs)
    along = round(sqrt(FRAMES * COLS / ROWS))
    across = ceil(FRAMES / along)
    places = []
    for k in range(FRAMES):
        row = (k // along) * (ROWS - SIDE) // (across - 1)
        col = (k % along) * (COLS - SIDE) // (along - 1)
        places.append(Place("frame", Window(row, col, SIDE, SIDE)))
    return PlacedScene(grid, None, places, [], [])


def _count(number):
    return f"{number:.1e}".replace("e+", "e")


def _tb(size):
    return f"{size / 1e12:.1f} TB"


def as_page():
    """The table as it stands in docs/scaling.md."""
    lines = ["| what | how | how much |", "|---|---|---|"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in table())]) + "\n"


if __name__ == "__main__":
    print(as_page(), end="")
