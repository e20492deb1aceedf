"""Episodes are made from demonstrations that open their object."""

import pytest

from aomgen.errors import EstimationError
from aomgen.replacement.stage import require_opening


def test_an_opening_passes():
    require_opening("opening")


def test_a_closing_is_refused_with_what_to_do():
    with pytest.raises(EstimationError, match=r"closes the object.*leave `assets` empty"):
        require_opening("closing")
