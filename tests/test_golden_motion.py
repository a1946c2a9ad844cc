"""Golden numbers of equations of motion; see test_golden.py."""

from __future__ import annotations

import pytest
from test_golden import assert_golden, specs


@pytest.mark.parametrize("spec", specs("motion"))
@pytest.mark.usefixtures("golden_folder", "without_figures")
def test_equations_of_motion(spec):
    assert_golden(spec)
