"""Parameters are changed by name; what does not fit is named with what would."""

from dataclasses import dataclass, field

import pytest

from aomgen.errors import ConfigError
from aomgen.io.schema import flatten, merge, override, parse_setting


@dataclass(frozen=True)
class Inner:
    nodes: int = 24
    ratio: float = 0.5


@dataclass(frozen=True)
class Outer:
    joint: Inner = field(default_factory=Inner)
    name: str = "a"
    quick: bool = False
    steps: tuple[int, ...] = (1, 2)


@pytest.mark.parametrize(
    ("setting", "want"),
    [
        ("joint.nodes=30", Outer(joint=Inner(nodes=30))),
        ("joint.ratio=2", Outer(joint=Inner(ratio=2.0))),
        ("name=b", Outer(name="b")),
        ("quick=true", Outer(quick=True)),
    ],
)
def test_a_setting_changes_one_field(setting, want):
    assert override(Outer(), parse_setting(setting), "motion") == want


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("joint.node=30", "'motion.joint.node': is unknown; did you mean 'nodes'"),
        ("joint.nodes=1.5", "'motion.joint.nodes': is 1.5; expected a whole number"),
        ("joint.nodes=true", "is True; expected a whole number"),
        ("joint=3", "'motion.joint': is 3; expected its fields"),
        ("steps=3", "'motion.steps': is 3"),
        ("quick=1", "'motion.quick': is 1; expected true or false"),
    ],
)
def test_what_does_not_fit_is_refused(setting, message):
    with pytest.raises(ConfigError, match=message.replace(".", r"\.")):
        override(Outer(), parse_setting(setting), "motion")


@pytest.mark.parametrize("text", ["motion.joint.nodes", "=3", "motion..nodes=3", "motion.nodes="])
def test_a_setting_needs_a_name_and_a_value(text):
    with pytest.raises(ConfigError, match="is not a parameter"):
        parse_setting(text)


def test_later_settings_win_and_keep_their_neighbours():
    both = merge(parse_setting("a.b=1"), merge(parse_setting("a.c=2"), parse_setting("a.b=3")))
    assert flatten(both) == {"a.b": 3, "a.c": 2}
