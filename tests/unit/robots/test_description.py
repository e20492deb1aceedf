"""robot.toml: what it says counts, and what the model does not have is refused by name."""

import pytest

from aomgen.errors import ConfigError, MalformedFileError, MissingFileError
from aomgen.robots.description import (
    FILE_NAME,
    description_toml,
    find_description,
    read_description,
    robot_references,
)
from aomgen.robots.loading import load_robot
from aomgen.robots.propose import propose_description


@pytest.fixture
def described(write_urdf):
    """The small robot with its draft beside it; the text of the draft can be changed."""
    model = write_urdf()
    draft = propose_description(model, model.parent)
    path = model.parent / FILE_NAME

    def write(*changes: tuple[str, str]):
        text = description_toml(draft)
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        path.write_text(text)
        return model

    return write


def test_a_draft_written_down_is_the_draft(described):
    model = described()
    draft = propose_description(model, model.parent)
    assert read_description(model.parent / FILE_NAME) == draft


def test_names_may_contain_quotes(write_urdf):
    model = write_urdf()
    text = model.read_text()
    for name in ("small", "elbow", "palm", "slide_a", "finger_a"):
        text = text.replace(f'"{name}"', f'"my &quot;{name}&quot;"')
    model.write_text(text)
    draft = propose_description(model, model.parent)
    path = model.parent / FILE_NAME
    path.write_text(description_toml(draft))
    assert read_description(path) == draft


def test_what_a_person_corrects_counts(described):
    robot = load_robot(
        described(('"slide_a" = 0.04', '"slide_a" = 0.03'), ('name = "small"', 'name = "mine"'))
    )
    assert robot.name == "mine"
    assert robot.drive.driver_range == (0.03, 0.0)


def test_a_robot_needs_its_description_wherever_it_goes(described):
    model = described()
    assert robot_references(model, model.parent) == (model.parent / FILE_NAME,)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('body = "finger_a"', 'body = "thumb"'), r"body 'thumb' as gripper\.\w+\.body"),
        (('"slide_a" = 0.0 ', '"slide_c" = 0.0 '), "different joints"),
        (('"slide_a"', '"slide_c"'), r"joint 'slide_c' as gripper\.open"),
        (('body = "palm"', 'site = "tip"'), r"site 'tip' as end_effector\.site"),
        (('body = "palm"', ""), "a site or a body"),
        (('"slide_a" = 0.04', '"slide_a" = 0.0'), "from open to closed"),
        (('"slide_a" = 0.04', '"slide_a" = 0.07'), "does not reach the values of gripper.open"),
        (("joints = [", 'joint = ["hip"]\njoints = ['), "did you mean 'joints'"),
        (('["shoulder", "elbow"', '["shoulder", "hip"'), "no joint 'hip'"),
        (('model = "robot.urdf"', 'model = "other.urdf"'), "describes other.urdf"),
    ],
)
def test_what_the_model_does_not_have_is_refused(described, change, message):
    with pytest.raises(MalformedFileError, match=message):
        load_robot(described(change))


def test_an_end_effector_that_looks_aside_is_refused(described):
    model = described()
    path = model.parent / FILE_NAME
    lines = path.read_text().splitlines()
    number = next(k for k, line in enumerate(lines) if line.startswith("quat_wxyz"))
    lines[number] = "quat_wxyz = [0.7071, 0.0, 0.0, 0.7071]"
    turned = load_robot(model).ee_poses([[0.0, 0.0, 0.0]])[0]
    if abs(turned[1, 1]) < 0.5:
        lines[number] = "quat_wxyz = [1.0, 0.0, 0.0, 0.0]"
    path.write_text("\n".join(lines))
    with pytest.raises(MalformedFileError, match="left to the right pad"):
        load_robot(model)


def test_a_log_of_other_joints_is_refused(described):
    model = described()
    with pytest.raises(ConfigError, match="shoulder, elbow, wrist"):
        load_robot(model, joints=("shoulder", "elbow"))


def test_a_missing_description_says_how_to_write_one(tmp_path):
    assert find_description(tmp_path / "robot.urdf") is None
    with pytest.raises(MissingFileError, match="aomgen robot propose"):
        read_description(tmp_path / FILE_NAME)
