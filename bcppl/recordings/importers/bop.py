"""A frame of a BOP data set: one depth image, and one of the objects in it whose pose is sought.

The format is that of the BOP benchmark (Hodan et al., BOP: Benchmark for 6D Object Pose Estimation, 2018),
as a folder of one scene: `camera.json`, `scene_gt.json`, `depth_FRAME.png`, `rgb_FRAME.png`, `models_eval/`.
The world's frame is the camera's. BOP scenes are judged by ADD under a tenth of the object's diameter:
sensor and ground truth differ by up to 6.5 mm along the ray.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import torch
import typer
from PIL import Image
from scipy.optimize import brentq

from bcppl import strict_json
from bcppl.arguments import LARGEST_SEED, number_within
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.geometry.mesh_file import read_mesh
from bcppl.geometry.parts import Guess, Part
from bcppl.poses import from_rotation_matrix, identity, retract
from bcppl.sensors import DepthImage, Measurement, Recording, View

NAME = "bop"
HELP = (
    "One object in a frame of a BOP scene (depth image, ground truth, mesh), the guess drawn about the truth."
)

DEPTH_MODES, COLOUR_MODES = ("I;16", "I"), ("RGB",)
MOST = 1e9  # of any number in the files
MOST_PIXELS = 8 << 20  # beyond one for each byte of the file: an image of depth takes 64 MB
NEAR, FAR = 0.2, 2.5  # m: a structured-light sensor's range


def command(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Folder of the scene.")],
    object_id: Annotated[int, typer.Option("--object", help="Which object is sought (its BOP id).")],
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Seed of the guess.")] = 0,
    translation: Annotated[float, typer.Option(help="Half width of the prior's box, m.")] = 0.04,
    angle: Annotated[float, typer.Option(help="Largest rotation of the prior, degrees.")] = 25.0,
    frame: Annotated[int | None, typer.Option(help="Which frame; the first if not given.")] = None,
) -> Recording:
    """Read one view of one object; of several instances, the first.

    Raises:
        InputError: a file of the scene is missing or unreadable, or the frame or object is not in it.
    """
    scene = Path(scene)
    number_within("the prior's half width is {} m", translation, least=0.0)
    number_within("the prior's angle is {} degrees", angle, above=0.0, most=180.0)
    return _read(scene, object_id, frame, seed, translation, math.radians(angle))


def _read(
    scene: Path, object_id: int, frame: int | None, seed: int, translation: float, angle: float
) -> Recording:
    listed = scene / "scene_gt.json"
    truths = _json(listed)
    if strange := [name for name in truths if not (name.isascii() and name.isdecimal())]:
        raise InputError(f"{listed} has a frame {strange[0]!r}; name frames by their numbers.")
    number = min(map(int, truths), default=-1) if frame is None else frame
    if str(number) not in truths:
        raise InputError(f"{scene} has no frame {number}; give --frame one of {', '.join(truths) or 'none'}.")
    entries = truths[str(number)]
    if not isinstance(entries, list) or not all(_has_id(each) for each in entries):
        what = f"{scene} is not laid out as a BOP scene (in {listed} an object has no obj_id)"
        raise InputError(f"{what}; compare its files with the format.")
    present = {each["obj_id"]: each for each in reversed(entries)}
    if object_id not in present:
        ids = ", ".join(map(str, sorted(present)))
        raise InputError(f"{scene} holds no object {object_id}; give --object one of {ids}.")
    instance = present[object_id]
    rotation = _numbers(instance, "cam_R_m2c", 9, listed).reshape(3, 3)
    moved = 1e-3 * _numbers(instance, "cam_t_m2c", 3, listed)
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 0.02 or np.linalg.det(rotation) < 0:
        raise InputError(f"{listed} has a cam_R_m2c that is no rotation; copy it again.")
    # Ground truth is printed with eight digits; its rotation is orthogonal to that.
    left, _, right = np.linalg.svd(rotation)
    truth = from_rotation_matrix(torch.from_numpy(moved), torch.from_numpy(left @ right))
    camera, image = _view(scene, number)
    return Recording(
        part=_part(scene / "models_eval" / f"obj_{object_id:06d}.ply", object_id),
        guess=Guess(
            world_from_part=retract(truth, -torch.from_numpy(draw(seed, translation, angle))).numpy(),
            translation=np.full(3, translation),
            angle=angle,
        ),
        measurements=[Measurement(View(camera), image)],
        truth=truth.numpy(),
        model="part_in_view",
        source=f"BOP {scene.resolve().name}, frame {number}, object {object_id}; licence of the data set",
    )


def draw(seed: int, translation: float, angle: float) -> Array:
    """A tangent (6,): a translation uniform in a box, a rotation uniform (Haar) within an angle.

    Under the Haar measure a rotation's angle a has density proportional to 1 - cos a, its axis is uniform.

    Args:
        seed: of the draw.
        translation: half width of the box, metres.
        angle: the largest rotation, radians.
    """
    rng = np.random.default_rng(seed)
    shift = rng.uniform(-translation, translation, 3)
    mass = rng.uniform(0.0, angle - math.sin(angle))
    turn = brentq(lambda a: a - math.sin(a) - mass, 0.0, angle)
    axis = rng.normal(size=3)
    return np.concatenate([shift, turn * axis / np.linalg.norm(axis)])


def _view(scene: Path, frame: int) -> tuple[Camera, DepthImage]:
    file = scene / "camera.json"
    intrinsics = _json(file)
    depth = _image(scene / f"depth_{frame:06d}.png", DEPTH_MODES).astype(np.float64)
    colour = scene / f"rgb_{frame:06d}.png"
    rgb = _image(colour, COLOUR_MODES) if colour.is_file() else None
    height, width = depth.shape
    if rgb is not None and rgb.shape[:2] != depth.shape:
        raise InputError(
            f"{colour} is of another size than the depth image; give both as one camera took them."
        )
    k = _numbers(intrinsics, "cam_K", 9, file).reshape(3, 3)
    scale = _numbers({"depth_scale": [intrinsics.get("depth_scale", 1.0)]}, "depth_scale", 1, file)
    camera = Camera(
        name="sensor",
        width=width,
        height=height,
        fx=float(k[0, 0]),
        fy=float(k[1, 1]),
        cx=float(k[0, 2]),
        cy=float(k[1, 2]),
        world_from_camera=identity().numpy(),
        near=NEAR,
        far=FAR,
    )
    metres = 1e-3 * float(scale[0]) * depth
    metres[depth == 0] = np.nan
    # As float32, so that a recording is the same before and after it was saved.
    return camera, DepthImage(metres.astype(np.float32).astype(np.float64), rgb)


def _part(path: Path, object_id: int) -> Part:
    if not path.is_file():
        raise InputError(f"{path} is missing: the scene has no mesh of object {object_id}; put it there.")
    mesh = read_mesh(path)
    return Part(
        name=f"object {object_id}",
        vertices=1e-3 * np.asarray(mesh.vertices, dtype=np.float64),
        faces=np.asarray(mesh.faces, dtype=np.int64),
        source="mesh of a BOP data set; licence as of that data set",
    )


def _json(path: Path) -> dict[str, Any]:
    content = strict_json.read(path, "give the folder of a BOP scene")
    if not isinstance(content, dict):
        raise InputError(f"{path} holds no object of JSON; give the folder of a BOP scene.")
    return content


def _has_id(entry: object) -> bool:
    return isinstance(entry, dict) and type(entry.get("obj_id")) is int


def _numbers(entry: dict[str, Any], name: str, count: int, path: Path) -> Array:
    """The numbers (count,) of a name in a file.

    Raises:
        InputError: it is missing, or something else.
    """
    held = entry.get(name)
    values = held if isinstance(held, list) else []
    if len(values) != count or not all(type(each) in (int, float) and abs(each) < MOST for each in values):
        raise InputError(f"{path} needs a {name} of {count} number{'s' * (count > 1)}; copy it again.")
    return np.asarray(values, dtype=np.float64)


def _image(path: Path, modes: Sequence[str]) -> npt.NDArray[Any]:
    """The pixels of a PNG file, whose checksums are compared.

    Raises:
        InputError: it is missing, is no PNG of such modes, is damaged, or too large for the bytes it has.
    """
    try:
        with _opened(path) as image:
            image.verify()  # reads all chunks, and none of the pixels
        with _opened(path) as image:
            if image.mode not in modes:
                raise ValueError(f"its mode is {image.mode}, not {' or '.join(modes)}")
            return np.asarray(image)
    except Exception as error:  # Pillow raises SyntaxError, struct.error, zlib.error and others
        reason = getattr(error, "strerror", None) or " ".join(str(error).split()) or type(error).__name__
        what = f"{path} is missing or is no image that can be read ({reason})"
        raise InputError(f"{what}; give the folder of a BOP scene.") from error


def _opened(path: Path) -> Image.Image:
    """A PNG file whose header alone is read: formats that Pillow gives to other programs are none."""
    image = Image.open(path, formats=["PNG"])
    if image.width * image.height > MOST_PIXELS + path.stat().st_size:
        raise ValueError(f"it claims {image.width} x {image.height} pixels in {path.stat().st_size} bytes")
    return image
