"""What the figures draw: the right numbers, in millimetres, in the right places."""

from __future__ import annotations

import io
import re

import numpy as np
import pytest
import torch
import trimesh
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection

from bcppl.beliefs import Belief
from bcppl.cli.page import page
from bcppl.errors import InferenceError, InputError
from bcppl.figures import (
    action_in_3d,
    add_over_time,
    belief_in_3d,
    depth_residual,
    gains_on_part,
    gap_over_time,
    marginals,
    outlines_on_depth,
    spread_over_time,
    touches_on_part,
    wrench_over_time,
)
from bcppl.figures.space_elements import MANY_FACES
from bcppl.geometry.camera import Camera
from bcppl.geometry.parts import Part
from bcppl.rendering.rasterisation import renderer_for
from bcppl.sensors import DepthImage, Measurement, Plan, Probe, ProbeWindow, Push, Touch, View

HALF = np.sqrt(0.5)


def box() -> Part:
    mesh = trimesh.creation.box((0.10, 0.08, 0.03))
    return Part("block", np.asarray(mesh.vertices), np.asarray(mesh.faces))


def small_peg() -> Part:
    mesh = trimesh.creation.box((0.01, 0.01, 0.01))
    return Part("peg", np.asarray(mesh.vertices), np.asarray(mesh.faces))


def poses(count: int, spread: float, seed: int = 0) -> np.ndarray:
    values = np.zeros((count, 7))
    values[:, :3] = [0.5, 0.1, 0.02] + spread * np.random.default_rng(seed).normal(size=(count, 3))
    values[:, 3] = 1.0
    return values


def rendered(figure: Figure) -> None:
    page = io.BytesIO()
    figure.savefig(page, dpi=40)
    assert page.tell() > 1000


def test_add_over_time_draws_the_weighted_mean_in_millimetres() -> None:
    adds = np.array([[0.010, 0.030], [0.001, 0.005]])
    weights = np.array([[1.0, 1.0], [3.0, 1.0]])  # in any scale
    figure = add_over_time(np.arange(2.0), adds, weights, ["view", "touch"], contact_start=1)
    (axes,) = figure.axes
    (mean,) = axes.get_lines()
    np.testing.assert_allclose(mean.get_ydata(), [20.0, 2.0])
    assert [label.get_text() for label in axes.get_xticklabels()] == ["view", "touch"]
    rendered(figure)


def test_heavier_particles_are_more_opaque_and_weightless_ones_do_no_harm() -> None:
    adds = np.full((3, 3), 0.004)
    weights = np.tile([0.0, 0.2, 0.8], (3, 1))
    figure = add_over_time(np.arange(3.0), adds, weights, list("abc"))
    opacity = figure.axes[0].collections[-1].get_facecolor()[:3, 3]
    assert np.all(np.diff(opacity) > 0.0)
    rendered(figure)


def test_one_particle_and_one_measurement() -> None:
    rendered(add_over_time(np.zeros(1), np.zeros((1, 1)), np.ones((1, 1)), ["start"], contact_start=0))
    rendered(belief_in_3d(box(), [("only", poses(1, 0.0), np.zeros(1))]))


@pytest.mark.parametrize("weights", [np.zeros((1, 2)), np.array([[np.nan, 1.0]]), np.array([[-1.0, 3.0]])])
def test_weights_that_are_none_are_refused(weights: np.ndarray) -> None:
    with pytest.raises(InputError, match="not their logarithms"):
        add_over_time(np.zeros(1), np.ones((1, 2)), weights, ["start"])


def test_belief_with_a_particle_of_no_weight_at_all() -> None:
    log_weights = np.array([0.0, -np.inf, -1.0, -np.inf])
    figure = belief_in_3d(box(), [("start", poses(4, 0.01), log_weights)], truth=poses(1, 0.0)[0])
    rendered(figure)
    with pytest.raises(InferenceError, match="no particle has any weight"):
        belief_in_3d(box(), [("start", poses(2, 0.01), np.full(2, -np.inf))])
    with pytest.raises(InferenceError, match="not a number"):
        belief_in_3d(box(), [("start", poses(2, 0.01), np.array([0.0, np.nan]))])


def test_the_title_states_how_far_the_weighted_mean_is_from_the_truth() -> None:
    two = poses(2, 0.0)
    two[1, 0] += 0.008
    figure = belief_in_3d(box(), [("x", two, np.log([0.75, 0.25]))], truth=poses(1, 0.0)[0])
    assert "mean off by 2 mm, 0°" in figure.axes[0].get_title()
    assert "spread 3.5 mm" in figure.axes[0].get_title()  # 8 mm sqrt(0.75 * 0.25)


def test_arrows_are_the_z_axis_and_ticks_the_x_axis_in_the_world() -> None:
    truth = np.array([0.1, 0.2, 0.3, HALF, HALF, 0.0, 0.0])  # a quarter turn about x takes z to -y
    figure = belief_in_3d(box(), [("x", truth[None], np.zeros(1))], truth=truth)
    drawn = [c for c in figure.axes[0].collections if isinstance(c, Line3DCollection)]
    cyan = [c for c in drawn if c.get_linewidth()[0] > 4.0]
    arrow, tick = (np.asarray(c._segments3d[0])[::-1] for c in cyan)  # quiver's shafts run from tip to foot
    for segment in (arrow, tick):
        np.testing.assert_allclose(segment[0], [100.0, 200.0, 300.0], atol=1e-9)
    along = (arrow[1] - arrow[0]) / np.linalg.norm(arrow[1] - arrow[0])
    np.testing.assert_allclose(along, [0.0, -1.0, 0.0], atol=1e-9)
    across = (tick[1] - tick[0]) / np.linalg.norm(tick[1] - tick[0])
    np.testing.assert_allclose(across, [1.0, 0.0, 0.0], atol=1e-9)


def test_a_large_mesh_is_drawn_from_few_triangles() -> None:
    mesh = trimesh.creation.icosphere(5, 0.05)
    assert len(mesh.faces) > MANY_FACES
    ball = Part("ball", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    figure = belief_in_3d(ball, [("a", poses(3, 0.01), np.zeros(3)), ("b", poses(3, 0.001), np.zeros(3))])
    assert figure.axes[0].get_xlim() == figure.axes[1].get_xlim()
    rendered(figure)


def placed_camera() -> Camera:
    return Camera("c", 8, 6, 9.0, 9.5, 3.7, 2.4, np.array([0.1, 0.2, 0.6, 0.0, 1.0, 0.0, 0.0]), 0.06, 4.0)


def test_a_plan_is_drawn_as_the_path_of_the_tip_and_coloured_by_manner() -> None:
    down = np.array([0.5, 0.1, 0.3, 0.0, 1.0, 0.0, 0.0])  # a half turn about x: the peg's z is downwards
    knots = np.stack([down, down - [0.0, 0.0, 0.1, 0, 0, 0, 0], down])
    plan = Plan("touch", np.arange(3.0), knots, ("guarded", "free"), 4.0, np.ones(6), np.ones(6))
    peg = box().moved([0.0, 0.0, -0.02, 1.0, 0.0, 0.0, 0.0])  # from z = -35 mm to -5 mm: its tip
    belief = "next", poses(9, 0.01), np.zeros(9)
    figure = action_in_3d(box(), belief, plan, peg, [plan, plan])
    (axes,) = figure.axes
    drawn = {line.get_label(): np.transpose(line.get_data_3d()) for line in axes.get_lines()}
    np.testing.assert_allclose(drawn["guarded"], [[500, 100, 335], [500, 100, 235]], atol=1e-9)
    np.testing.assert_allclose(drawn["free"], [[500, 100, 235], [500, 100, 335]], atol=1e-9)
    faint = [line for line in axes.get_lines() if line.get_linewidth() < 1.0]
    assert len(faint) == 2 and all(len(line.get_data_3d()[0]) == 3 for line in faint)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["guarded", "free", "particles (z axes)", "other candidates"]
    assert "as if nothing were met" in axes.get_title()
    without = action_in_3d(box(), belief, plan).axes[0].get_lines()[0]
    np.testing.assert_allclose(without.get_data_3d()[2], [300.0, 200.0], atol=1e-9)
    rendered(figure)


def test_a_view_is_drawn_as_a_line_from_the_camera_to_the_mean() -> None:
    belief = "next", poses(1, 0.0), np.zeros(1)
    figure = action_in_3d(box(), belief, View(placed_camera()))
    (axes,) = figure.axes
    (line,) = axes.get_lines()
    np.testing.assert_allclose(np.transpose(line.get_data_3d()), [[100, 200, 600], [500, 100, 20]], atol=1e-9)
    assert axes.get_zlim()[1] >= 600.0 and axes.get_title().count("\n") == 1
    path = np.arange(2.0), np.tile(placed_camera().world_from_camera, (2, 1))
    with pytest.raises(InputError, match="a push cannot be drawn"):
        action_in_3d(box(), belief, Push(*path))


# ---- images and touches


def over_the_box() -> tuple[Camera, np.ndarray, np.ndarray]:
    """A camera that looks straight down at the box, its pose, and the depth that it would measure."""
    pose = poses(1, 0.0)[0]
    above = np.array([0.5, 0.1, 0.52, 0.0, 1.0, 0.0, 0.0])
    camera = Camera("c", 64, 48, 100.0, 100.0, 31.5, 23.5, above, 0.1, 2.0)
    depth = np.full((48, 64), 0.5)
    rendered_depth = renderer_for(box()).images(camera, pose[None])[0]
    depth[np.isfinite(rendered_depth)] = 0.485  # the top of the box is 15 mm above its middle
    return camera, pose, depth


@pytest.mark.long
def test_the_outline_is_where_the_part_is_seen_and_the_residual_is_measured_minus_rendered() -> None:
    camera, pose, depth = over_the_box()
    axes = Figure().add_subplot()
    outlines_on_depth(axes, View(camera), DepthImage(depth), box(), pose, [pose], pose)
    drawn = [path for c in axes.collections for path in c.get_paths() if len(path.vertices)]
    assert len(drawn) == 3
    span = np.ptp(drawn[1].vertices, axis=0)
    np.testing.assert_allclose(span, [100.0 * 0.10 / 0.485, 100.0 * 0.08 / 0.485], atol=1.1)
    farther = Figure().add_subplot()
    depth_residual(farther, View(camera), DepthImage(depth + 0.004), box(), pose)
    off = np.ma.filled(farther.images[0].get_array(), np.nan)
    assert np.nanmedian(off) == pytest.approx(4.0, abs=1e-3) and "median 4.0 mm" in farther.get_title()
    behind = Camera(**{**vars(camera), "world_from_camera": np.array([0.5, 0.1, 0.52, 1.0, 0.0, 0.0, 0.0])})
    empty = Figure().add_subplot()
    outlines_on_depth(empty, View(behind), DepthImage(depth), box(), pose)
    assert "nothing of the part in view" in empty.get_title()
    rendered(farther.figure)


def test_forces_are_tared_and_contact_is_marked_where_it_is_felt() -> None:
    times = np.arange(100) / 100.0
    wrench = np.tile([1.0, -2.0, 0.5, 0.0, 0.0, 0.0], (100, 1))
    wrench[40:60, 2] += 5.0
    pose = np.tile([0.5, 0.1, 0.05, 1.0, 0.0, 0.0, 0.0], (100, 1))
    probe = Probe("p", times[[0, -1]], pose[:2], np.ones(6), np.ones(6), times)
    windows = [
        Measurement(ProbeWindow(probe, a, b), Touch(times[a:b], wrench[a:b], pose[a:b]))
        for a, b in ((0, 50), (50, 100))
    ]
    axes = wrench_over_time(Figure().add_subplot(), windows)
    along = {line.get_label(): line.get_ydata() for line in axes.get_lines()}
    assert np.abs(along["along the peg's x"]).max() < 1e-12
    assert along["along the peg's z"].max() == pytest.approx(5.0)
    marked = np.concatenate([path.vertices[:, 0] for path in axes.collections[0].get_paths()])
    assert marked.min() > 0.39 and marked.max() < 0.61
    seen = touches_on_part(Figure(), (1, 1, 1), windows, box(), box(), poses(1, 0.0)[0])
    (tip,) = {tuple(np.round(each, 6)) for each in np.transpose(seen.collections[-1]._offsets3d)}
    assert tip == (0.0, 0.0, 15.0)  # 30 mm above the part's middle, less half of the peg
    rendered(seen.figure)


@pytest.mark.long
def test_the_gap_by_a_belief_is_drawn_in_millimetres_with_what_was_felt() -> None:
    times = np.arange(100) / 100.0
    pose = np.tile([0.5, 0.1, 0.05, 1.0, 0.0, 0.0, 0.0], (100, 1))
    # The part's top is at 35 mm, the peg's tip 5 mm below its middle: 20 mm between them, 0.4, then contact.
    pose[:, 2] = 0.04 + 0.02
    pose[30:40, 2], pose[40:60, 2] = 0.0404, 0.04
    wrench = np.zeros((100, 6))
    wrench[40:60, 2] = 5.0
    probe = Probe("p", times[[0, -1]], pose[:2], np.ones(6), np.ones(6), times)
    windows = [Measurement(ProbeWindow(probe, 0, 100), Touch(times, wrench, pose))]
    stood = np.tile(poses(1, 0.0), (3, 1))
    stood[:, 2] = 0.02 + np.array([-1e-4, 0.0, 1e-4])
    belief = Belief(torch.from_numpy(stood), torch.zeros(3, dtype=torch.float64))
    axes = gap_over_time(Figure().add_subplot(), windows, box(), small_peg(), belief)
    median = next(line for line in axes.get_lines() if line.get_label() == "median")
    at, gap = median.get_data()
    np.testing.assert_allclose(gap[(at >= 0.4) & (at < 0.6)], 0.0, atol=1e-3)
    np.testing.assert_allclose(gap[(at >= 0.3) & (at < 0.4)], 0.4, atol=1e-3)
    band = next(each for each in axes.collections if each.get_label() == "middle 90 %")
    reached = np.concatenate([path.vertices for path in band.get_paths()])
    during = reached[(reached[:, 0] >= 0.42) & (reached[:, 0] < 0.58), 1]
    assert during.min() == pytest.approx(-0.1, abs=1e-3) and during.max() == pytest.approx(0.1, abs=1e-3)
    felt = next(each for each in axes.collections if each.get_label() == "contact felt")
    marked = np.concatenate([path.vertices[:, 0] for path in felt.get_paths()])
    assert marked.min() > 0.39 and marked.max() < 0.61
    rendered(axes.figure)


def test_gains_are_drawn_where_plans_meet_the_part() -> None:
    down = np.array([0.5, 0.1, 0.3, 1.0, 0.0, 0.0, 0.0])
    knots = np.stack([down, down - [0.0, 0.0, 0.29, 0, 0, 0, 0]])
    aside = np.array([0.03, 0, 0, 0, 0, 0, 0])
    plans = [
        Plan("touch", np.arange(2.0), knots + side * aside, ("guarded",), 4.0, np.ones(6), np.ones(6))
        for side in (-1, 1)
    ]
    peg = small_peg()
    axes = gains_on_part(Figure(), (1, 1, 1), plans, [2.0, 1.0], box(), peg, poses(1, 0.0)[0])
    drawn = next(each for each in axes.collections if hasattr(each, "_offsets3d"))
    x, y, z = np.asarray(drawn._offsets3d)
    np.testing.assert_allclose(drawn.get_array(), [1.0, 2.0])  # the largest last
    assert (np.sign(x) == [1, -1]).all() and (np.abs(np.abs(x) - 30.0) <= 5.0 + 1e-6).all()
    assert (np.abs(y) <= 5.0 + 1e-6).all()
    np.testing.assert_allclose(z, 15.0, atol=1e-6)  # on the part's upper face, in its frame
    with pytest.raises(InputError, match="one each"):
        gains_on_part(Figure(), (1, 1, 1), plans, [2.0], box(), peg, poses(1, 0.0)[0])
    rendered(axes.figure)


def test_marginals_are_in_millimetres_and_degrees_about_the_mean() -> None:
    values = poses(50, 0.002)
    figure = marginals(Belief(torch.from_numpy(values), torch.zeros(50).double()), truth=values[0])
    rows = np.array(figure.axes).reshape(6, 6)
    assert rows[5, 0].get_xlabel() == "x (mm)" and rows[5, 5].get_xlabel() == "about z (°)"
    scatter = rows[1, 0].collections[0].get_offsets()
    expected = 1e3 * (values[:, :2] - values[:, :2].mean(axis=0))
    np.testing.assert_allclose(np.asarray(scatter), expected, atol=1e-9)
    rendered(figure)


def test_a_page_is_one_file_that_names_no_other_and_runs_nothing() -> None:
    axes = spread_over_time(Figure().add_subplot(), ["prior", "push 1"], np.array([9.0, 0.5]))
    record = {"recording": "<script>x</script>", "complete": False, "warnings": ["a & b"], "version": "1"}
    row = {"measurement": "prior", "ESS": "75.0"}
    text = page(record, "the hole is at 1 2 3 mm", [row], [("spread", axes.figure)])
    assert "<script" not in text and "a &amp; b" in text and "stopped before its end" in text
    assert "75.0" in text and not re.findall(r"(?:src|href)='(?!data:image/png)", text)
    assert "http" not in text
