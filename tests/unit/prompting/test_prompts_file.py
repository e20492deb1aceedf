import tomllib

import pytest

from aomgen.capture.capture_schema import PromptSection
from aomgen.errors import InputError
from aomgen.prompting.prompts_file import replace_prompts, save_prompts

PROMPTS = [
    PromptSection(part="moving", image='odd "name".jpg', points=[[312.04, 220.0, 1], [3.0, 4.0, 0]]),
    PromptSection(part="robot", image="0001.jpg", box=[1.0, 2.0, 300.0, 400.0]),
]


def test_only_prompts_change(sample):
    text = (sample / "capture.toml").read_text("utf-8")
    changed = replace_prompts(text, PROMPTS, {})
    assert changed.startswith(text[: text.index("\n[[prompts]]")])
    assert [PromptSection(**item) for item in tomllib.loads(changed)["prompts"]] == [
        PROMPTS[0].model_copy(update={"points": [[312.0, 220.0, 1], [3.0, 4.0, 0]]}),
        PROMPTS[1],
    ]
    assert replace_prompts(changed, PROMPTS, {}) == changed


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_comments_and_tables_after_prompts_stay(newline):
    lines = ["# by hand", "format = 1  # first", "", "[[prompts]]", 'part = "robot"', "points = [", "  [1, 2, 1],", "]", "",
             "[scan]  # last", "images = 'scan'"]  # fmt: skip
    changed = replace_prompts(newline.join(lines), PROMPTS[1:], {}).split(newline)
    assert changed[:6] == ["# by hand", "format = 1  # first", "", "[scan]  # last", "images = 'scan'", ""]
    assert changed[6:] == [
        "[[prompts]]",
        'part = "robot"',
        'image = "0001.jpg"',
        "box = [1.0, 2.0, 300.0, 400.0]",
        "",
    ]


def test_comments_of_a_person_stay():
    lines = ["format = 1", "", "# by mouse", "[[prompts]]", 'part = "robot"', "", "# the door", "[[prompts]]",
             'part = "moving"', "", "# measured on 3 May", "[scan]", "images = 'scan'"]  # fmt: skip
    changed = replace_prompts("\n".join(lines), PROMPTS[1:], {})
    assert changed.startswith(
        "format = 1\n\n# by mouse\n# the door\n# measured on 3 May\n[scan]\nimages = 'scan'\n\n[[prompts]]\n"
    )
    assert replace_prompts(changed, PROMPTS[1:], {}) == changed


def test_a_byte_order_mark_stays(tmp_path):
    path = tmp_path / "capture.toml"
    path.write_text("\ufeffformat = 1\n", "utf-8")
    save_prompts(path, PROMPTS, {"category": "oven"})
    assert path.read_bytes().startswith(b'\xef\xbb\xbfformat = 1\ncategory = "oven"\n\n[[prompts]]')


def test_prompts_in_one_line_are_replaced():
    changed = replace_prompts('prompts = [{part = "robot"}]\nformat = 1\n', PROMPTS[1:], {})
    assert changed.startswith("format = 1\n\n[[prompts]]\n")


def test_all_prompts_may_go(sample):
    changed = replace_prompts((sample / "capture.toml").read_text("utf-8"), [], {})
    assert "prompts" not in tomllib.loads(changed)


def test_damaged_file_stays(tmp_path):
    path = tmp_path / "capture.toml"
    path.write_text("format = ")
    with pytest.raises(InputError):
        save_prompts(path, PROMPTS, {})
    assert path.read_text() == "format = "
    with pytest.raises(InputError):
        save_prompts(tmp_path / "none.toml", PROMPTS, {})


def test_stated_values_change_and_keep_their_comments():
    text = 'format = 1\ncategory = "TODO"   # of the object\nname = "a"\n'
    changed = replace_prompts(text, [], {"category": 'micro"wave', "name": "a"})
    assert changed == 'format = 1\ncategory = "micro\\"wave"   # of the object\nname = "a"\n'
