"""A scene of a BOP data set: depth images of one or more frames, and one object, whose pose is sought.

The layout is that of docs/bop_datasets_format.md of github.com/thodan/bop_toolkit (BOP-scenewise), the names
of files are those of its bop_toolkit_lib/dataset_params.py (Hodan et al., BOP: Benchmark for 6D Object Pose
Estimation, 2018); see `scene`. Where the cameras are stated in a world, that is the recording's world;
otherwise it is the camera's frame. BOP scenes are judged by ADD under a tenth of the object's diameter: in
LM-O sensor and ground truth differ by up to 6.5 mm along the ray.
"""

import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer

from bcppl.arguments import LARGEST_SEED, number_within
from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.geometry.camera import Camera
from bcppl.geometry.mesh_file import read_mesh
from bcppl.geometry.parts import Guess, Part
from bcppl.poses import compose, identity, local
from bcppl.recordings.importers.bop.guess import draw, drawn, offset_by, stated
from bcppl.recordings.importers.bop.images import COLOURS, depth_in_metres, pixels
from bcppl.recordings.importers.bop.scene import FlatScene, Optics, Scene, content, listed, scene_in
from bcppl.sensors import DepthImage, Measurement, Recording, View

__all__ = ["HELP", "NAME", "command", "draw"]

NAME = "bop"
HELP = "One object in frames of a BOP scene (depth images, ground truth, mesh), by a guess about the truth."

NEAR, FAR = 0.2, 2.5  # m: a structured-light sensor's range
MOVED, TURNED = 0.005, math.radians(2.0)  # by which ground truths of one pose differ between frames
_MEASURED = 0.02  # of its size, by which a mesh differs from what models_info.json states


def command(
    scene: Annotated[
        Path, typer.Argument(metavar="SCENE", help="Folder of the scene, such as DATASET/test/000001.")
    ],
    object_id: Annotated[int, typer.Option("--object", help="Which object is sought (its BOP id).")],
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Seed of the guess.")] = 0,
    translation: Annotated[float, typer.Option(help="Half width of the prior's box, m.")] = 0.04,
    angle: Annotated[float, typer.Option(help="Largest rotation of the prior, degrees.")] = 25.0,
    frame: Annotated[
        list[int] | None, typer.Option(help="Which frame, repeated for several; the first if not given.")
    ] = None,
    instance: Annotated[int, typer.Option(min=0, help="Which of the object's instances, from 0.")] = 0,
    offset: Annotated[
        str | None,
        typer.Option(
            help='Of the guess from the truth, instead of a draw: "x y z" m, rotation vector degrees.'
        ),
    ] = None,
    guess: Annotated[
        str | None, typer.Option(help='The guess itself, "x y z qw qx qy qz"; then no truth is needed.')
    ] = None,
    models: Annotated[
        str | None, typer.Option(help="Folder of the meshes; models_eval if it is there.")
    ] = None,
    sensor: Annotated[str, typer.Option(help="Of a data set with several: scene_camera_SENSOR.json.")] = "",
) -> Recording:
    """Read the views of one instance of an object.

    Raises:
        InputError: a file of the scene is missing or unreadable, the frame or object is not in it, or the
            viewpoints of several frames are not known.
    """
    number_within("the prior's half width is {} m", translation, least=0.0)
    number_within("the prior's angle is {} degrees", angle, above=0.0, most=180.0)
    if offset is not None and guess is not None:
        raise InputError("--offset and --guess both state the guess; give one of them.")
    folder = scene_in(Path(scene), sensor, models)
    annotated = guess is None or folder.truth_file.is_file()
    frames = _frames(folder, folder.frames(annotated), frame)
    seen = [folder.instances(each, object_id) for each in frames] if annotated else []
    cameras = [folder.optics(each) for each in frames]
    truth = _truth(folder, frames, cameras, seen, (object_id, instance)) if annotated else None
    if truth is None:
        _refuse_unknown_viewpoints(folder, cameras)
    return Recording(
        part=_part(folder.mesh(object_id), object_id),
        guess=Guess(
            world_from_part=_guess(truth, seed, translation, math.radians(angle), offset, guess),
            translation=np.full(3, translation),
            angle=math.radians(angle),
        ),
        measurements=_views(folder, frames, cameras),
        truth=truth,
        model="part_in_view",
        source=f"BOP {_name(folder)}, {_words(frames)}, object {object_id}; licence of the data set",
    )


def _guess(
    truth: Array | None, seed: int, translation: float, angle: float, offset: str | None, guess: str | None
) -> Array:
    if guess is not None:
        return stated(guess)
    assert truth is not None
    return drawn(truth, seed, translation, angle) if offset is None else offset_by(truth, offset)


def _frames(folder: Scene, there: list[int], asked: list[int] | None) -> list[int]:
    """The frames that are asked for, each once; the first of all if none is."""
    chosen = list(dict.fromkeys(asked)) if asked else there[:1] or [-1]
    for number in chosen:
        if number not in there:
            raise InputError(f"{folder.folder} has no frame {number}; give --frame one of {listed(there)}.")
    return chosen


def _truth(
    folder: Scene,
    frames: list[int],
    cameras: list[Optics],
    seen: list[list[Array]],
    which: tuple[int, int],
) -> Array:
    """The pose (7,) of an instance in the world, by the first frame.

    In the other frames, an instance has to be at the same place; instances need not be listed alike.

    Args:
        folder: the scene.
        frames: numbers of frames.
        cameras: of the frames.
        seen: of each frame the poses of the object's instances, `camera_from_part`.
        which: the object, and its instance.

    Raises:
        InputError: none is, so that the part moved, or the frames' viewpoints are not known.
    """
    (object_id, instance), first = which, seen[0]
    if instance >= len(first):
        known = f"0 to {len(first) - 1}" if len(first) > 1 else "0"
        raise InputError(
            f"{folder.folder} holds {len(first)} of object {object_id} in frame {frames[0]}; give "
            f"--instance {known}."
        )
    truth = _placed(_origin(cameras[0]), first[instance])
    for number, optics, instances in zip(frames[1:], cameras[1:], seen[1:], strict=True):
        if (optics.world_from_camera is None) != (cameras[0].world_from_camera is None):
            raise InputError(
                f"{folder.folder} states cam_R_w2c of some of the frames {listed(frames)} alone; give the "
                "others, or one --frame."
            )
        others = [_placed(_origin(optics), each) for each in instances]
        apart = [local(torch.from_numpy(truth), torch.from_numpy(each)).numpy() for each in others]
        near = min(apart, key=lambda tangent: float(np.linalg.norm(tangent[:3])))
        shift, turn = float(np.linalg.norm(near[:3])), float(np.linalg.norm(near[3:]))
        if shift > MOVED or turn > TURNED:
            away = f"{1000.0 * shift:.0f} mm and {math.degrees(turn):.0f} degrees elsewhere in frame {number}"
            if optics.world_from_camera is None:
                raise InputError(
                    f"{folder.folder} states no cam_R_w2c, and object {object_id} is seen {away} than in "
                    f"frame {frames[0]}: their viewpoints are not known; give one --frame."
                )
            raise InputError(
                f"object {object_id} is {away} of {folder.folder} than in frame {frames[0]}; give frames "
                "between which it did not move."
            )
    return truth


def _refuse_unknown_viewpoints(folder: Scene, cameras: list[Optics]) -> None:
    if len(cameras) > 1 and any(each.world_from_camera is None for each in cameras):
        raise InputError(
            f"{folder.folder} states neither cam_R_w2c nor ground truth of several frames: their viewpoints "
            "are not known; give one --frame."
        )


def _placed(world_from_camera: Array, camera_from_part: Array) -> Array:
    return compose(torch.from_numpy(world_from_camera), torch.from_numpy(camera_from_part)).numpy()


def _origin(optics: Optics) -> Array:
    return identity().numpy() if optics.world_from_camera is None else optics.world_from_camera


def _views(folder: Scene, frames: list[int], cameras: list[Optics]) -> list[Measurement]:
    """A view of each frame; those from one viewpoint share their camera."""
    views: list[Measurement] = []
    known: dict[tuple[object, ...], Camera] = {}
    for number, optics in zip(frames, cameras, strict=True):
        depth = depth_in_metres(folder.depth(number), optics.scale)
        colour = folder.colour(number)
        rgb = pixels(colour, COLOURS[colour.suffix]) if colour.is_file() else None
        if rgb is not None and rgb.shape[:2] != depth.shape:
            raise InputError(
                f"{colour} is of another size than the depth image; give both as one camera took them."
            )
        k, place = optics.matrix, _origin(optics)
        viewpoint = (depth.shape, k.tobytes(), place.tobytes())
        if viewpoint not in known:
            several = len(frames) > 1
            known[viewpoint] = Camera(
                name=f"sensor {number}" if several else "sensor",
                width=depth.shape[1],
                height=depth.shape[0],
                fx=float(k[0, 0]),
                fy=float(k[1, 1]),
                cx=float(k[0, 2]),
                cy=float(k[1, 2]),
                world_from_camera=place,
                near=NEAR,
                far=FAR,
                device="sensor" if several else "",
            )
        views.append(Measurement(View(known[viewpoint]), DepthImage(depth, rgb)))
    return views


def _part(path: Path, object_id: int) -> Part:
    """The mesh, in metres, of the size that `models_info.json` beside it states.

    Raises:
        InputError: it cannot be read, or is of another size.
    """
    mesh = read_mesh(path)
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    file = path.with_name("models_info.json")
    entry = _info(file, object_id) if file.is_file() else {}
    size = np.ptp(vertices, axis=0)
    for axis, name in enumerate(("size_x", "size_y", "size_z")):
        if type(entry.get(name)) in (int, float) and abs(size[axis] - entry[name]) > _MEASURED * size.max():
            raise InputError(
                f"{path} has a {name} of {size[axis]:.4g} mm, and {file.name} states {entry[name]:.4g}; copy "
                "both of one data set."
            )
    return Part(
        name=f"object {object_id}",
        vertices=1e-3 * vertices,
        faces=np.asarray(mesh.faces, dtype=np.int64),
        source="mesh of a BOP data set; licence as of that data set",
    )


def _info(file: Path, object_id: int) -> dict[str, Any]:
    entry = content(file).get(str(object_id), {})
    return entry if isinstance(entry, dict) else {}


def _name(folder: Scene) -> str:
    """The scene's folder, and where the layout is the published one the split and the data set before it."""
    place = folder.folder.resolve()
    return place.name if isinstance(folder, FlatScene) else "/".join(place.parts[-3:])


def _words(frames: list[int]) -> str:
    return f"frame {frames[0]}" if len(frames) == 1 else f"frames {listed(frames)}"
