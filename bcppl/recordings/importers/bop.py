"""A frame of a BOP data set: one depth image, and one of the objects in it whose pose is sought.

The format is that of the BOP benchmark (Hodan et al., BOP: Benchmark for 6D Object Pose Estimation, 2018),
as a folder of one scene: `camera.json`, `scene_gt.json`, `depth_FRAME.png`, `rgb_FRAME.png`, `models_eval/`.
The world's frame is the camera's. BOP scenes are judged by ADD under a tenth of the object's diameter:
sensor and ground truth differ by up to 6.5 mm along the ray.
"""

import json
import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import torch
import trimesh
import typer
from PIL import Image
from scipy.optimize import brentq

from bcppl.arguments import LARGEST_SEED, number_within
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Guess, Part
from bcppl.poses import from_rotation_matrix, identity, retract
from bcppl.sensors import DepthImage, Measurement, Recording, View

NAME = "bop"
HELP = (
    "One object in a frame of a BOP scene (depth image, ground truth, mesh), the guess drawn about the truth."
)

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
    try:
        return _read(scene, object_id, frame, seed, translation, math.radians(angle))
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        details = f"{type(error).__name__}: {' '.join(str(error).split())}"
        what = f"{scene} is not laid out as a BOP scene ({details})"
        raise InputError(f"{what}; compare its files with the format.") from error


def _read(
    scene: Path, object_id: int, frame: int | None, seed: int, translation: float, angle: float
) -> Recording:
    truths = _json(scene / "scene_gt.json")
    number = min(map(int, truths), default=-1) if frame is None else frame
    if str(number) not in truths:
        raise InputError(f"{scene} has no frame {number}; give --frame one of {', '.join(truths) or 'none'}.")
    present = {entry["obj_id"]: entry for entry in reversed(truths[str(number)])}
    if object_id not in present:
        ids = ", ".join(map(str, sorted(present)))
        raise InputError(f"{scene} holds no object {object_id}; give --object one of {ids}.")
    instance = present[object_id]
    rotation = np.reshape(instance["cam_R_m2c"], (3, 3)).astype(np.float64)
    moved = 1e-3 * np.asarray(instance["cam_t_m2c"], dtype=np.float64)
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
    intrinsics = _json(scene / "camera.json")
    depth = _image(scene / f"depth_{frame:06d}.png").astype(np.float64)
    if depth.ndim != 2:
        raise InputError(f"{scene} has a depth image of shape {depth.shape}; give one of a single channel.")
    colour = scene / f"rgb_{frame:06d}.png"
    rgb = _image(colour).astype(np.uint8) if colour.is_file() else None
    height, width = depth.shape
    k = np.reshape(intrinsics["cam_K"], (3, 3)).astype(np.float64)
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
    metres = 1e-3 * float(intrinsics.get("depth_scale", 1.0)) * depth
    metres[depth == 0] = np.nan
    # As float32, so that a recording is the same before and after it was saved.
    return camera, DepthImage(metres.astype(np.float32).astype(np.float64), rgb)


def _part(path: Path, object_id: int) -> Part:
    if not path.is_file():
        raise InputError(f"{path} is missing: the scene has no mesh of object {object_id}; put it there.")
    mesh: Any = trimesh.load(path, process=False, force="mesh")
    return Part(
        name=f"object {object_id}",
        vertices=1e-3 * np.asarray(mesh.vertices, dtype=np.float64),
        faces=np.asarray(mesh.faces, dtype=np.int64),
        source="mesh of a BOP data set; licence as of that data set",
    )


def _json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{path} is missing or is no JSON; give the folder of a BOP scene.") from error
    return dict(content)


def _image(path: Path) -> npt.NDArray[Any]:
    try:
        with Image.open(path) as image:
            return np.asarray(image)
    except OSError as error:
        raise InputError(f"{path} is missing or is no image; give the folder of a BOP scene.") from error
