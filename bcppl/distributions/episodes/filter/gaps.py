"""The gaps of a probe's rows, linear in the parameters, as the compiled filter is given them."""

from __future__ import annotations

from typing import NamedTuple

from bcppl.arrays import Array
from bcppl.compiled import summed


class Gaps(NamedTuple):
    """The gaps of N particles at R rows, for D delays of the wrench; see `switching_filter.filtered`.

    Attributes:
        distance: (N, R) m, without errors and delay.
        force: (R,) N.
        gradient: (N, R, P) the derivatives by parameters before the shared errors.
        slope: (N, R, 6) by a twist of the peg.
        late: (D, R, 6) the twists of a delay.
        twist: (D, R, 6, K) the derivatives of a row's twist by the K shared errors.
        offset: (D, R, K) those of its gap.
        trust: (N, D, R) factors of the errors and columns of contacts, or nothing.
        residual: (N, R, J) the deviations of further errors that an episode's rows share.
    """

    distance: Array
    force: Array
    gradient: Array
    slope: Array
    late: Array
    twist: Array
    offset: Array
    trust: Array
    residual: Array


@summed
def line(gaps: Gaps, n: int, delay: int, row: int, column: Array) -> float:
    """Set `column` (P + K + 2,) to the derivatives of a gap; returns it without errors, with a delay.

    Those by the parameters of a contact are 0.
    """
    distance, own = gaps.distance[n, row], gaps.gradient.shape[2]
    column[own + gaps.offset.shape[2] :] = 0.0
    for a in range(own):
        column[a] = gaps.gradient[n, row, a]
    for m in range(gaps.offset.shape[2]):
        column[own + m] = gaps.offset[delay, row, m]
    for a in range(6):
        share = gaps.slope[n, row, a]
        distance += share * gaps.late[delay, row, a]
        for m in range(gaps.offset.shape[2]):
            column[own + m] += share * gaps.twist[delay, row, a, m]
    return distance
