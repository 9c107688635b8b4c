"""What is in a bag, and a configuration of it with guesses, to be edited."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bcppl.errors import InputError
from bcppl.recordings.importers.bag import reading
from bcppl.recordings.importers.bag.images import encoded
from bcppl.recordings.importers.bag.reading import Bag, Topic
from bcppl.recordings.importers.bench.configuration.drafts import GUESS, drafted, offer, refuse_place, spelled
from bcppl.untrusted.visible_text import visible

_LOOKED_AT = 200  # messages of a topic that a guess is made from


def show(path: Path, write: Path | None) -> None:
    """List the topics of a bag, and print a configuration of it, or write it to a file.

    Raises:
        InputError: the bag is damaged, or the file exists.
    """
    refuse_place(write)
    console = Console()
    with Bag(path) as bag:
        table = Table("topic", "type", "messages", "mean rate", box=None, pad_edge=False)
        for each in sorted(bag.topics.values(), key=lambda topic: topic.name):
            lasts = bag.end - bag.begin
            rate = f"{(each.count - 1) / lasts:.4g} Hz" if lasts > 0.0 and each.count > 1 else "-"
            kind = each.type.replace("/msg/", "/") or "several"
            table.add_row(escape(visible(each.name)), escape(visible(kind)), str(each.count), rate)
        text = configuration(bag)
        span = f"{path}: {bag.end - bag.begin:.2f} s from {bag.begin:.3f} s on, by the recorder's clock"
        if not bag.topics:
            raise InputError(f"{path} has no topic; give a bag in which something was recorded.")
    console.print(visible(span), markup=False, highlight=False, soft_wrap=True)
    console.print(table)
    offer(console, text, write, f"bcppl import bag {path} {write}")


def configuration(bag: Bag) -> str:
    """The configuration of a bag in YAML: of `bcppl new bench`, with topics for files."""
    command = f"bcppl import bag {spelled(bag.path.name)} CONFIG"
    return drafted(command, "the bag", _wrench(bag) + _motion(bag), _cameras(bag))


def _wrench(bag: Bag) -> str:
    return (
        f"wrench:\n{_topic(bag, reading.WRENCH, '/wrench')}"
        "  axes: sensor                              # in which it is expressed: sensor, frame or base\n"
        "  about: sensor                             # the point of its torques: sensor, frame, peg or base\n"
        "  sign: on_peg                              # what the part exerts on the peg, or by_peg\n"
    )


def _motion(bag: Bag) -> str:
    kinds = {topic.type for topic in bag.topics.values() if topic.count}
    if reading.POSE in kinds or not kinds & {reading.TRANSFORMS, reading.JOINTS}:
        return f"pose:\n{_topic(bag, reading.POSE, '/pose')}"
    if reading.TRANSFORMS in kinds:
        parent, child = _frames(bag)
        words = f"  parent: {spelled(parent)}  {GUESS}\n  child: {spelled(child)}  {GUESS}\n"
        return f"pose:\n{_topic(bag, reading.TRANSFORMS, '/tf')}{words}"
    return (
        f"joints:\n{_topic(bag, reading.JOINTS, '/joint_states')}"
        "  urdf: robot.urdf                          # the joints are those up to its link `tip`\n"
        "  tip: tool0\n"
    )


def _cameras(bag: Bag) -> str:
    depth = [topic for topic in _of(bag, reading.IMAGE) if _is_depth(bag, topic)]
    if not depth:
        return "# no topic of depth images (16UC1 or 32FC1) was found\n"
    lines = ["cameras:\n"]
    for k, topic in enumerate(depth):
        info = _nearest(topic.name, [each.name for each in _of(bag, reading.CAMERA)])
        intrinsics = f"info: {spelled(info)}, " if info else "fx: 320, fy: 320, cx: 159.5, cy: 119.5, "
        lines.append(
            f"  camera_{k}:  {GUESS}\n"
            f"    {{topic: {spelled(topic.name)}, {intrinsics}near: 0.1, far: 2,\n"
            "     frame_from_camera: {xyz: [0.06, 0, 0.04]},   # or world_from_camera, if it stands\n"
            "     every: 2.0}                                  # s; or images: [{time: 1.5}, {time: 4.0}]\n"
        )
    return "".join(lines)


def _of(bag: Bag, kind: str) -> list[Topic]:
    return sorted((t for t in bag.topics.values() if t.type == kind and t.count), key=lambda t: t.name)


def _topic(bag: Bag, kind: str, example: str) -> str:
    """The line of the topic of a type with most messages; the others are named."""
    found = sorted((t for t in _of(bag, kind)), key=lambda topic: -topic.count)
    if not found:
        return f"  topic: {example}  # none of {kind.replace('/msg/', '/')} was found\n"
    others = f"; others: {', '.join(spelled(t.name) for t in found[1:])}" if found[1:] else ""
    frame = _header_frame(bag, found[0])
    of = f", in the frame {spelled(frame)}" if frame else ""
    return f"  topic: {spelled(found[0].name)}  {GUESS}{of}{others}\n"


def _header_frame(bag: Bag, topic: Topic) -> str:
    """The frame that the header of the topic's first message names, if it has one."""
    first = next(bag.messages([topic.name]), None)
    return "" if first is None else str(getattr(getattr(bag.parsed(first), "header", None), "frame_id", ""))


def _is_depth(bag: Bag, topic: Topic) -> bool:
    first = next(bag.messages([topic.name]), None)
    return first is not None and encoded(bag.parsed(first)) is not None


def _frames(bag: Bag) -> tuple[str, str]:
    """The root of the transforms, and the leaf with most transforms on its way."""
    above: dict[str, str] = {}
    for topic in _of(bag, reading.TRANSFORMS):
        for _, message in zip(range(_LOOKED_AT), bag.messages([topic.name]), strict=False):
            for each in bag.parsed(message).transforms:
                above[each.child_frame_id.lstrip("/")] = each.header.frame_id.lstrip("/")
    longest: list[str] = []
    for leaf in sorted(set(above) - set(above.values())):
        way = [leaf]
        while way[-1] in above and above[way[-1]] not in way:
            way.append(above[way[-1]])
        longest = max(longest, way[::-1], key=len)
    return (longest[0], longest[-1]) if longest else ("base", "tool0")


def _nearest(topic: str, others: list[str]) -> str | None:
    """The topic in the same namespace."""
    same = [each for each in others if each.rpartition("/")[0] == topic.rpartition("/")[0]]
    return same[0] if same else None
