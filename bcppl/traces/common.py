"""What a program has at any values of the same addresses, so that it need not be run again to find out."""

from __future__ import annotations

from dataclasses import dataclass, field

from bcppl.distributions.support import Support


@dataclass(eq=False)
class Common:
    """What a trace and those of particles chosen from it have in common, as far as it was asked for.

    Attributes:
        addresses: in the order of the program, if they were asked for.
        supports: of latent addresses, where they depend on no value.
    """

    addresses: tuple[str, ...] | None = None
    supports: dict[str, Support] = field(default_factory=dict)
