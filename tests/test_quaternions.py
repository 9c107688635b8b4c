"""Quaternions: the algebra of RoMa to the bit, and gradients where it is delicate."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import roma
import torch
from torch import Tensor

from bcppl import quaternions

SHAPES = ((), (1,), (75,), (4, 1, 9), (0,))
SCALES = (0.0, 1e-9, 1e-3, 5e-3, 1.0, 3.0, 10.0)  # rad: about the switch to a series, and beyond a half turn


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def laid_out(values: Tensor) -> list[Tensor]:
    """The same numbers, contiguous and not."""
    return [values, torch.cat([values, values], dim=-1)[..., : values.shape[-1]]]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("scale", SCALES)
def test_the_exponential_map_and_its_inverse_are_romas_to_the_bit(
    shape: tuple[int, ...], scale: float
) -> None:
    for vector in laid_out(scale * random(*shape, 3)):
        expected = roma.rotvec_to_unitquat(vector)
        assert torch.equal(quaternions.from_rotation_vector(vector), expected)
        for sign in (1.0, -1.0):
            back = quaternions.rotation_vector(sign * expected)
            assert torch.equal(back, roma.unitquat_to_rotvec(sign * expected))


@pytest.mark.parametrize("shape", SHAPES)
def test_products_and_matrices_are_romas_to_the_bit(shape: tuple[int, ...]) -> None:
    for first, second in zip(laid_out(random(*shape, 4)), laid_out(random(*shape, 4, seed=1)), strict=True):
        first = first / first.norm(dim=-1, keepdim=True)
        assert torch.equal(quaternions.product(first, second), roma.quat_product(first, second))
        assert torch.equal(quaternions.conjugate(first), roma.quat_conjugation(first))
        matrix = roma.unitquat_to_rotmat(first)
        assert torch.equal(quaternions.rotation_matrix(first), matrix)
        assert torch.equal(quaternions.from_rotation_matrix(matrix), roma.rotmat_to_unitquat(matrix))


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
