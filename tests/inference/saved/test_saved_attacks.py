"""Files that are damaged, changed, or of another program are refused in one sentence, and run nothing."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyro
import pyro.distributions as dist
import pytest
import torch

from bcppl.errors import InputError
from bcppl.inference import importance_sampling, saved
from bcppl.inference.population import Population
from bcppl.inference.saved import plain
from bcppl.traces import Series, Trace, extend
from bcppl.traces.series import SeriesTrace
from tests.inference.saved.saved_programs import FORGETFUL, KEPT, WALK, groups
from tests.invariance import number
from tests.made_recordings import assert_one_sentence


def two(scale: float) -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), scale))
    y = pyro.sample("y", dist.Normal(number(1.0), 2.0))
    pyro.sample("seen", dist.Normal(x + y, 0.5))


def other_likelihood(scale: float) -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), scale))
    y = pyro.sample("y", dist.Normal(number(1.0), 2.0))
    pyro.sample("seen", dist.Normal(x - y, 0.5))


def more(scale: float) -> None:
    two(scale)
    pyro.sample("z", dist.Normal(number(0.0), 1.0))


def fewer(scale: float) -> None:
    x = pyro.sample("x", dist.Normal(number(0.0), scale))
    pyro.sample("seen", dist.Normal(x, 0.5))


def reshaped(scale: float) -> None:
    x = pyro.sample("x", dist.Normal(torch.zeros(2).double(), scale).to_event(1))
    y = pyro.sample("y", dist.Normal(number(1.0), 2.0))
    pyro.sample("seen", dist.Normal(x[..., 0] + y, 0.5))


def failing(scale: float) -> None:
    raise KeyError(scale)


def discrete(scale: float) -> None:
    pyro.sample("x", dist.Categorical(torch.ones(3).double()))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    population = importance_sampling(two, (1.5,), {"seen": number(0.7)}, 20)
    saved.save(population, tmp_path / "two.h5")
    return tmp_path / "two.h5"


def refused(path: Path, match: str, program: Any = two, args: Any = None) -> None:
    with pytest.raises(InputError, match=match) as caught:
        saved.load(path, program, args)
    assert path.name in str(caught.value)
    assert_one_sentence(str(caught.value).replace(f"{path}: ", "").replace("two.h5 ", "").replace(".h5", ""))


@pytest.mark.parametrize(
    ("program", "match"),
    [
        (other_likelihood, "'other_likelihood' gives site 'seen' log-probability"),
        (more, "no value at address 'z', which the program visits"),
        (fewer, "address 'y' is one the program never visits"),
        (reshaped, "value of site 'x' has shape"),
        (failing, r"cannot be run at its values \(KeyError: 1.5\)"),
        (WALK, "the file is of one program, but the program given is a series"),
    ],
)
def test_another_program_is_named(path: Path, program: Any, match: str) -> None:
    refused(path, match, program)


def test_other_arguments_are_named(path: Path) -> None:
    refused(path, r"saved with the arguments \(1.5,\)", args=(1.6,))
    refused(path, "arguments are of type float; give a tuple", args=1.5)
    assert len(saved.load(path, two, (1.5,))) == 20


def test_the_number_of_one_program_is_not_that_of_another(tmp_path: Path) -> None:
    saved.save(KEPT["series"].begun(1), tmp_path / "s.h5")
    refused(tmp_path / "s.h5", "it was made with `history=True`", FORGETFUL)
    refused(tmp_path / "s.h5", "file is of a series, but the program given is one program", two)
    refused(tmp_path / "s.h5", "arguments of 2 steps are given, but the file has 6", WALK, [(1.0,), (0.9,)])
    refused(tmp_path / "s.h5", "gives site", Series(WALK.init, lambda x, drag: WALK.step(x, 0.5)))


def test_arguments_that_are_no_data_are_given_at_load(tmp_path: Path) -> None:
    @dataclass
    class Scene:
        scale: float

    def program(scene: Scene) -> None:
        two(scene.scale)

    population = importance_sampling(program, (Scene(1.5),), {"seen": number(0.7)}, 20)
    saved.save(population, tmp_path / "p.h5")
    refused(tmp_path / "p.h5", r"its arguments \(Scene\) cannot be saved; give them as `args`", program)
    refused(tmp_path / "p.h5", "gives site 'x' log-probability", program, (Scene(1.6),))
    again = saved.load(tmp_path / "p.h5", program, (Scene(1.5),))
    assert torch.equal(again.trace["x"], population.trace["x"])


# ---------------------------------------------------------------- files that were changed


def test_a_file_cut_off_anywhere_is_refused(path: Path) -> None:
    whole = path.read_bytes()
    for share in (0.0, 0.01, 0.2, 0.5, 0.8, 0.95, 0.999):
        path.write_bytes(whole[: int(share * len(whole))])
        refused(path, "damaged|holds no population")


def test_a_changed_bit_anywhere_in_the_numbers_is_seen(path: Path) -> None:
    whole = path.read_bytes()
    with h5py.File(path) as file:
        places = [file[name].id.get_offset() + k for name in ("structure", "numbers") for k in (0, 40, 401)]
    for place in places:
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        refused(path, "damaged")


def rewritten(path: Path, change: Callable[[dict[str, Any]], Any], **attributes: Any) -> None:
    """The file with other content, whose hash is right."""
    with h5py.File(path) as file:
        content, kept = plain.read(file), dict(file.attrs)
    change(content)
    with h5py.File(path, "w") as file:
        file.attrs.update({**kept, **attributes})
        plain.write(file, content)


def values(content: dict[str, Any]) -> dict[str, Any]:
    first: dict[str, Any] = content["populations"][0]["trace"]["steps"][0]
    return first


def swap(content: dict[str, Any]) -> None:
    choices = values(content)["choices"]
    choices["x"], choices["y"] = choices["y"], choices["x"]


def whole_numbers(content: dict[str, Any]) -> None:
    values(content)["choices"]["x"] = torch.zeros(20, dtype=torch.int64)


def shortened(content: dict[str, Any]) -> None:
    values(content)["choices"]["x"] = torch.zeros(19).double()


def one_for_all(content: dict[str, Any]) -> None:
    values(content)["choices"]["x"] = number(0.0)


def weights_of_others(content: dict[str, Any]) -> None:
    content["populations"][0]["fields"]["log_weights"] = torch.zeros(21).double()


def weights_not_numbers(content: dict[str, Any]) -> None:
    content["populations"][0]["fields"]["log_weights"] = torch.full((20,), torch.nan).double()


def lost(content: dict[str, Any]) -> None:
    del values(content)["choices"]["x"]


def lost_part(content: dict[str, Any]) -> None:
    del content["populations"][0]["fields"]


def float_log_prob(content: dict[str, Any]) -> None:
    values(content)["known"]["x"] = torch.zeros(20)


def from_the_future(content: dict[str, Any]) -> None:
    content["populations"][0]["fields"]["halves"] = torch.zeros(20)


def state_of_none(content: dict[str, Any]) -> None:
    values(content)["carried"] = {"probe": {"rollout.rows": np.zeros((20, 3, 13))}}


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (swap, "gives site '[xy]' log-probability"),
        (whole_numbers, "value at 'x' is of torch.int64, the program's is real"),
        (shortened, "value of site 'x' has shape"),
        (one_for_all, "value at 'x' has shape"),
        (weights_of_others, "its log_weights are of 21 particles, the trace of 20"),
        (weights_not_numbers, "log weight nan"),
        (lost, "no value at address 'x'"),
        (lost_part, "lacks a part of a population"),
        (float_log_prob, "no log-probabilities at address 'x'"),
        (from_the_future, "field 'halves', which this bcppl does not know"),
        (state_of_none, "a simulator's state 'probe', which the program does not have"),
    ],
)
def test_changed_content_with_a_right_hash_is_refused(path: Path, change: Any, match: str) -> None:
    rewritten(path, change)
    refused(path, match)


def test_another_version_and_another_format_are_refused(path: Path) -> None:
    rewritten(path, lambda content: None, schema_version=9)
    refused(path, "schema version 9, this bcppl reads 1; upgrade")
    rewritten_format = path.with_name("b.h5")
    for other, match in (
        ("bcppl recording", "holds no population"),
        ("bcppl belief", "holds a belief and no population; give a file that `save` or `save_step` wrote"),
    ):
        with h5py.File(rewritten_format, "w") as file:
            file.attrs["format"] = other
        refused(rewritten_format, match)
    path.with_name("c.h5").write_text("no file of ours")
    refused(path.with_name("c.h5"), "damaged or no file of bcppl")
    with pytest.raises(InputError, match=r"there is no file .*nowhere\.h5"):
        saved.load(path.with_name("nowhere.h5"), two)


class Bomb:
    """Unpickling it would leave a mark."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (exec, ("import builtins; builtins.bomb_went_off = True",))


@pytest.mark.parametrize("name", ["structure", "numbers"])
def test_a_pickle_inside_does_not_run(path: Path, name: str) -> None:
    import builtins

    with h5py.File(path, "a") as file:
        del file[name]
        file.create_dataset(name, data=np.frombuffer(pickle.dumps(Bomb()), dtype=np.uint8))
        both = [np.asarray(file[each][()]).tobytes() for each in ("structure", "numbers")]
        file.attrs["sha256"] = plain._digest(*both)
    refused(path, "damaged")
    assert not hasattr(builtins, "bomb_went_off")


def linked(file: h5py.File, other: Path) -> None:
    file["numbers"] = h5py.ExternalLink(str(other), "/numbers")


def soft(file: h5py.File, other: Path) -> None:
    file["numbers"] = h5py.SoftLink("/structure")


def virtual(file: h5py.File, other: Path) -> None:
    with h5py.File(other) as source:
        layout = h5py.VirtualLayout(shape=source["numbers"].shape, dtype=np.uint8)
        layout[:] = h5py.VirtualSource(source["numbers"])
    file.create_virtual_dataset("numbers", layout)


def external(file: h5py.File, other: Path) -> None:
    file.create_dataset("numbers", shape=(100,), dtype=np.uint8, external=[(str(other), 0, 100)])


def enormous(file: h5py.File, other: Path) -> None:
    file.create_dataset("numbers", shape=(2**45,), dtype=np.uint8, chunks=(2**20,))


def objects(file: h5py.File, other: Path) -> None:
    file.create_dataset("numbers", data=["text"], dtype=h5py.string_dtype())


@pytest.mark.parametrize("put", [linked, soft, virtual, external, enormous, objects])
def test_numbers_from_elsewhere_are_not_read(path: Path, put: Any) -> None:
    other = path.with_name("other.h5")
    other.write_bytes(path.read_bytes())
    with h5py.File(path, "a") as file:
        del file["numbers"]
        put(file, other)
    refused(path, "damaged")


def test_descriptions_of_more_than_there_is_are_refused(path: Path) -> None:
    for shape, strides, dtype in (
        ([10**12], [1], "<f8"),
        ([-5], [1], "<f8"),
        ([20], [10**12], "|O"),
        ([2**32, 2**32], [1, 1], "|u1"),
    ):
        with h5py.File(path, "a") as file:
            structure = json.loads(bytes(np.asarray(file["structure"][()])))
            structure["random_state"] = ["tensor", dtype, shape, strides]
            text = json.dumps(structure).encode()
            del file["structure"]
            file.create_dataset("structure", data=np.frombuffer(text, dtype=np.uint8))
            file.attrs["sha256"] = plain._digest(text, np.asarray(file["numbers"][()]).tobytes())
        refused(path, "damaged")
    nested = b"[" * 100_000
    with h5py.File(path, "a") as file:
        del file["structure"]
        file.create_dataset("structure", data=np.frombuffer(nested, dtype=np.uint8))
        file.attrs["sha256"] = plain._digest(nested, np.asarray(file["numbers"][()]).tobytes())
    refused(path, "damaged")


# ---------------------------------------------------------------- what cannot be saved


def test_what_cannot_be_saved_is_named(tmp_path: Path) -> None:
    population = KEPT["groups"].begun(1)
    with pytest.raises(InputError, match="approximation of type object cannot be saved"):
        saved.save(population.with_approximation(object()), tmp_path / "p.h5")
    with pytest.raises(InputError, match="there is no folder"):
        saved.save(population, tmp_path / "nowhere" / "p.h5")

    class Own(Trace):
        pass

    own = Own(groups, (1,), 40, population.trace.choices, population.trace.observations)
    with pytest.raises(InputError, match="a Own cannot be saved"):
        saved.save(Population(own, population.log_weights), tmp_path / "p.h5")

    class Odd:
        def __getitem__(self, index: Any) -> Odd:
            return self

    def begin() -> Odd:
        pyro.sample("x", dist.Normal(number(0.0), 1.0))
        return Odd()

    def on(state: Odd) -> Odd:
        return begin()

    for history in (True, False):
        walk = Series(begin, on, history=history)
        population = importance_sampling(walk, (), {}, 5)
        population = population.with_trace(extend(population.trace, (), {})[0])
        if history:
            saved.save(population, tmp_path / "p.h5")
            assert isinstance(saved.load(tmp_path / "p.h5", walk).trace, SeriesTrace)
        else:
            with pytest.raises(InputError, match="state with a Odd, which cannot be saved"):
                saved.save(population, tmp_path / "p.h5")
    assert not list(tmp_path.glob("*.part"))
