"""Words that doubts share."""

from __future__ import annotations

from collections.abc import Sequence

MOST = 3  # names in a sentence


def listed(names: Sequence[str]) -> str:
    """Names in words: 'a', 'b' and 4 others."""
    quoted = [repr(name) for name in dict.fromkeys(names)]
    if len(quoted) > MOST:
        return f"{', '.join(quoted[: MOST - 1])} and {len(quoted) - MOST + 1} others"
    return " and ".join([", ".join(quoted[:-1]), quoted[-1]] if len(quoted) > 1 else quoted)


def of_probes(names: Sequence[str]) -> str:
    """Probes in words: probe 'a', probes 'a' and 'b'."""
    return f"probe{'s' if len(set(names)) > 1 else ''} {listed(names)}"
