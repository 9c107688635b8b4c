"""`check_program` names the mistake and the site of each wrong program, and refuses no right one."""

from __future__ import annotations

import pytest

from bcppl.traces import ProgramError, check_program
from tests.wrong_programs import WRONG


@pytest.mark.parametrize("name", WRONG)
def test_the_mistake_and_the_site_are_named(name: str) -> None:
    wrong = WRONG[name]
    with pytest.raises(ProgramError) as caught:
        check_program(wrong.program, wrong.args, wrong.observations, steps=wrong.steps)
    assert (caught.value.fault, caught.value.site) == (wrong.fault, wrong.site), str(caught.value)
    assert str(caught.value).endswith(".") and (wrong.site is None or repr(wrong.site) in str(caught.value))
