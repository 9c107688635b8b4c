"""A URDF file whose joints have other origins: how a calibrated arm is written down."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from bcppl.arrays import Array
from bcppl.errors import InputError
from bcppl.untrusted.plain_xml import refuse_entities


def corrected(file: str | Path, parent_from_child: Mapping[str, Array]) -> str:
    """The text of a URDF file with other origins of some joints; all else within its root is as it was.

    Comments before and after the root are left out, and prefixes of namespaces may be others.

    Args:
        file: the URDF file.
        parent_from_child: (4, 4) at joint value zero, by the joint's name.

    Raises:
        InputError: the file cannot be read, or has no joint of a name.
    """
    try:
        data = Path(file).read_bytes()
        refuse_entities(data)
        builder = ElementTree.TreeBuilder(insert_comments=True)
        root = ElementTree.fromstring(data, ElementTree.XMLParser(target=builder))
    except (OSError, ValueError, ElementTree.ParseError) as error:
        raise InputError(f"{file} cannot be read as a URDF ({error}); give the robot's URDF file.") from error
    joints = {joint.get("name"): joint for joint in root.findall("joint")}
    for name, matrix in parent_from_child.items():
        if name not in joints:
            raise InputError(f"{file} has no joint {name!r} to correct; give the file that was calibrated.")
        origin = joints[name].find("origin")
        if origin is None:
            origin = ElementTree.SubElement(joints[name], "origin")
        turn = Rotation.from_matrix(matrix[:3, :3]).as_euler("xyz")
        origin.set("xyz", " ".join(f"{number:.12g}" for number in np.asarray(matrix[:3, 3])))
        origin.set("rpy", " ".join(f"{number:.12g}" for number in turn))
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
