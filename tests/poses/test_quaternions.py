"""Quaternions: the algebra of RoMa to rounding, and gradients where it is delicate."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import roma
import torch
from torch import Tensor

from bcppl.poses import quaternions

SHAPES = ((), (1,), (75,), (4, 1, 9), (0,))
SCALES = (0.0, 1e-9, 1e-3, 5e-3, 1.0, 3.0, 10.0)  # rad: to beyond a half turn


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def same(actual: Tensor, expected: Tensor) -> None:
    """Equal to a few units of rounding, of the size of the largest entry too."""
    size = float(expected.abs().max()) if expected.numel() else 0.0
    torch.testing.assert_close(actual, expected, rtol=2e-15, atol=5e-15 * size)


def laid_out(values: Tensor) -> list[Tensor]:
    """The same numbers, contiguous and not."""
    return [values, torch.cat([values, values], dim=-1)[..., : values.shape[-1]]]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("scale", SCALES)
def test_the_exponential_map_and_its_inverse_are_romas(shape: tuple[int, ...], scale: float) -> None:
    for vector in laid_out(scale * random(*shape, 3)):
        expected = roma.rotvec_to_unitquat(vector)
        same(quaternions.from_rotation_vector(vector), expected)
        for sign in (1.0, -1.0):
            back = quaternions.rotation_vector(sign * expected)
            same(back, roma.unitquat_to_rotvec(sign * expected))


@pytest.mark.parametrize("shape", SHAPES)
def test_products_and_matrices_are_romas(shape: tuple[int, ...]) -> None:
    for first, second in zip(laid_out(random(*shape, 4)), laid_out(random(*shape, 4, seed=1)), strict=True):
        first = first / first.norm(dim=-1, keepdim=True)
        same(quaternions.product(first, second), roma.quat_product(first, second))
        same(quaternions.conjugate(first), roma.quat_conjugation(first))
        matrix = roma.unitquat_to_rotmat(first)
        same(quaternions.rotation_matrix(first), matrix)
        same(quaternions.from_rotation_matrix(matrix), roma.rotmat_to_unitquat(matrix))


def test_every_expression_for_the_quaternion_of_a_matrix_is_right() -> None:
    """Half turns about each axis and no turn: in each case another of the four divides by most."""
    for vector in (*(math.pi * torch.eye(3, dtype=torch.float64)), torch.zeros(3, dtype=torch.float64)):
        quaternion = quaternions.from_rotation_vector(vector)
        back = quaternions.from_rotation_matrix(quaternions.rotation_matrix(quaternion))
        torch.testing.assert_close(back * torch.sign(back @ quaternion), quaternion)


@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e-3, 0.5])
@pytest.mark.parametrize("function", [quaternions.from_rotation_vector, quaternions.rotation_vector])
def test_gradients_are_numbers_and_right_at_and_near_no_turn(
    function: Callable[[Tensor], Tensor], scale: float
) -> None:
    value = scale * random(5, 3)
    if function is quaternions.rotation_vector:
        value = quaternions.from_rotation_vector(value)
    value.requires_grad_()
    assert bool(torch.isfinite(torch.autograd.grad(function(value)[:, :3].sum(), value)[0]).all())
    if scale >= 1e-3:
        assert torch.autograd.gradcheck(function, (value,))
