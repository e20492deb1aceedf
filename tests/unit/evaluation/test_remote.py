"""Clients of openpi's and OpenVLA's servers, against servers on this machine that speak as those do."""

import gc
import json
import socket
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aomgen.core.transforms import matrix_from_rotvec, transform
from aomgen.datasets.features import ee_targets
from aomgen.errors import AomgenError, BackendError, ConfigError, PolicyServerError
from aomgen.evaluation import policy_servers
from aomgen.evaluation.policy_servers import OpenpiServer, _encode, _pack, read_array
from aomgen.evaluation.remote import delta_of_openvla, open_remote
from served_policies import json_array, msgpack_array, openpi_server, openvla_server

# What openpi_client 0.1.2 and json_numpy 2.1.1 make of the same observation and answer.
OPENPI_PACKED = (
    "83a6696d6167657381a566726f6e7484c40b5f5f6e6461727261795f5fc3c40464617461c40c000102030405060708090a0bc40564747970"
    "65a37c7531c405736861706593020203a5737461746584c40b5f5f6e6461727261795f5fc3c40464617461c4080000003f000080bfc40564"
    "74797065a33c6634c40573686170659102a670726f6d7074a46f70656e"
)
OPENPI_ANSWER = (
    "82a7616374696f6e7384c40b5f5f6e6461727261795f5fc3c40464617461c410000000000000f83f0000000000000040c4056474797065"
    "a33c6638c4057368617065920102a16e83c40d5f5f6e7067656e657269635f5fc3c40464617461cb4000000000000000c4056474797065"
    "a33c6634"
)
JSON_NUMPY = {
    "image": {"__numpy__": "AAECAwQFBgcICQoL", "dtype": "|u1", "shape": [2, 2, 3]},
    "s": {"__numpy__": "AAAAPwAAgL8=", "dtype": "<f4", "shape": [2]},
}
IMAGE = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
STATE = np.array([0.5, -1.0], np.float32)
T_WORLD_EE = transform(matrix_from_rotvec([0.3, -0.8, 1.1]), [0.4, -0.2, 0.3])


def task_in(action_space: str, joints: int = 6) -> tuple[SimpleNamespace, SimpleNamespace]:
    """What the client reads of a suite, and its robot."""
    suite = SimpleNamespace(
        task="open the microwave",
        action_space=action_space,
        cameras=("front", "side"),
        joint_names=range(joints),
    )
    return suite, SimpleNamespace(ee_poses=lambda joints: T_WORLD_EE[None])


def observation(gripper: float = 0.25) -> dict:
    images = {"front": IMAGE, "side": 255 - IMAGE}
    return {"pixels": images, "agent_pos": np.append(np.arange(6) / 10, gripper).astype(np.float32)}


CHUNK = np.arange(35, dtype=np.float32).reshape(5, 7)


def test_messages_are_those_of_the_public_libraries():
    import msgpack

    packed = msgpack.packb({"images": {"front": IMAGE}, "state": STATE, "prompt": "open"}, default=_pack)
    assert packed.hex() == OPENPI_PACKED
    assert json.loads(json.dumps({"image": IMAGE, "s": STATE}, default=_encode)) == JSON_NUMPY


def test_an_answer_of_the_public_library_is_read():
    with openpi_server(lambda _: bytes.fromhex(OPENPI_ANSWER)) as served:
        answer = OpenpiServer(served.address).infer({})
    np.testing.assert_array_equal(answer["actions"], [[1.5, 2.0]])
    assert answer["n"] == 2.0


def test_openpi_is_asked_by_the_names_of_the_recipe_and_again_when_the_chunk_is_used_up():
    with openpi_server(
        lambda _: {"actions": msgpack_array(CHUNK), "server_timing": {"infer_ms": 1.5}}
    ) as served:
        policy = open_remote(f"openpi://{served.address}", *task_in("joint"))
        policy.reset(None)
        looks, actions = [], []
        for frame in range(7):
            looks.append(policy.looks(frame))
            seen = observation() if looks[-1] else {"agent_pos": observation()["agent_pos"]}
            actions.append(policy.act(seen))
        asked = served.asked
    assert looks == [True, False, False, False, False, True, False]
    np.testing.assert_array_equal(actions, np.concatenate([CHUNK, CHUNK[:2]]))
    assert len(asked) == 2
    assert set(asked[0]) == {"images", "state", "prompt"}
    assert list(asked[0]["images"]) == ["front"]
    np.testing.assert_array_equal(asked[0]["images"]["front"], IMAGE)
    assert asked[0]["images"]["front"].dtype == np.uint8
    np.testing.assert_array_equal(asked[0]["state"], observation()["agent_pos"])
    assert asked[0]["prompt"] == "open the microwave"


def test_a_server_that_states_another_config_is_another_policy():
    digests = set()
    for config in ("first", "second", "second"):
        stated = {"action_space": "joint", "cameras": ["front"], "config": config}
        with openpi_server(lambda _: None, stated) as served:
            digests.add(open_remote(f"openpi://{served.address}", *task_in("joint")).digest)
    assert len(digests) == 2
    assert "" not in digests


def test_a_new_trial_forgets_the_last_chunk():
    with openpi_server(lambda _: {"actions": msgpack_array(CHUNK)}) as served:
        policy = open_remote(f"openpi://{served.address}", *task_in("joint"))
        policy.act(observation())
        assert not policy.looks(1)
        policy.reset(None)
        assert policy.looks(0)


@pytest.mark.parametrize("answer", [CHUNK[0], list(CHUNK)])
def test_openvla_answers_one_action_and_oft_a_list(answer):
    said = [json_array(row) for row in answer] if isinstance(answer, list) else json_array(answer)
    with openvla_server(lambda _: said) as served:
        policy = open_remote(f"openvla://{served.address}", *task_in("ee_delta"))
        actions = [policy.act(observation()) for _ in range(2)]
        asked = served.asked
    rows = np.atleast_2d(answer)
    np.testing.assert_allclose(actions[0], delta_of_openvla(rows[0], T_WORLD_EE))
    # The next one counts from where the first one led, not from where the arm is.
    T_world_target = ee_targets(T_WORLD_EE[None], actions[0][None, :6])[0]
    np.testing.assert_allclose(actions[1], delta_of_openvla(rows[min(1, len(rows) - 1)], T_world_target))
    assert len(asked) == (1 if isinstance(answer, list) else 2)
    assert set(asked[0]) == {"image", "full_image", "state", "instruction"}
    np.testing.assert_array_equal(asked[0]["image"], IMAGE)
    np.testing.assert_array_equal(asked[0]["full_image"], IMAGE)
    assert asked[0]["instruction"] == "open the microwave"
    # Six joints, one that the arm has not, and the gripper, 1 open.
    np.testing.assert_allclose(asked[0]["state"], [0, 0.1, 0.2, 0.3, 0.4, 0.5, 0, 0.75], atol=1e-7)


def matrix_of(axis: int, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    i, j = ((1, 2), (2, 0), (0, 1))[axis]
    R = np.eye(3)
    R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
    return R


numbers = st.floats(-1, 1)


@given(motion=st.tuples(*[numbers] * 6), pose=st.tuples(*[numbers] * 6), gripper=st.floats(0, 1))
@settings(max_examples=100)
def test_openvlas_motion_in_the_worlds_axes_reaches_the_same_target(motion, pose, gripper):
    T_world_ee = transform(matrix_from_rotvec(pose[3:]), pose[:3])
    action = delta_of_openvla(np.array([*motion, gripper]), T_world_ee)
    reached = ee_targets(T_world_ee[None], action[None, :6])[0]
    roll, pitch, yaw = (matrix_of(axis, angle) for axis, angle in enumerate(motion[3:]))
    np.testing.assert_allclose(reached[:3, 3], np.add(pose[:3], motion[:3]), atol=1e-12)
    np.testing.assert_allclose(reached[:3, :3], yaw @ pitch @ roll @ T_world_ee[:3, :3], atol=1e-9)
    assert action[6] == 1 - gripper


@pytest.mark.parametrize("place", range(7))
def test_what_is_no_number_is_left_for_the_environment_to_judge(place):
    action = np.full(7, 0.1, np.float32)
    action[place] = np.nan
    with openvla_server(lambda _: json_array(action)) as served:
        policy = open_remote(f"openvla://{served.address}", *task_in("ee_delta"))
        assert not np.isfinite(policy.act(observation())).all()
    with openpi_server(lambda _: {"actions": msgpack_array(action[None])}) as served:
        policy = open_remote(f"openpi://{served.address}", *task_in("joint"))
        assert np.isnan(policy.act(observation())[place])


def closed_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("openpi://localhost", "is not the address of a server; expected openpi://HOST:PORT"),
        ("openpi://localhost:70000", "is not the address of a server"),
        ("openpi://local host:80", "is not the address of a server"),
        ("openpi://me@host:80/act", "is not the address of a server"),
        ("openpie://localhost:80", "'openpie' is unknown; did you mean 'openpi'?"),
        ("http://localhost:80", "'http' is unknown; known: openpi, openvla"),
    ],
)
def test_addresses_are_refused(name, said):
    with pytest.raises(ConfigError, match="--policy") as caught:
        open_remote(name, *task_in("joint"))
    assert said in str(caught.value)


@pytest.mark.parametrize(("scheme", "space"), [("openpi", "joint"), ("openvla", "ee_delta")])
def test_a_server_that_is_away_is_told_before_work_starts(scheme, space):
    with pytest.raises(PolicyServerError) as caught:
        open_remote(f"{scheme}://127.0.0.1:{closed_port()}", *task_in(space))
    assert "does not reply" in str(caught.value)
    assert "start the server" in str(caught.value)
    assert caught.value.exit_code == BackendError.exit_code


def test_another_kind_of_server_is_told():
    with openvla_server(lambda _: {}) as served, pytest.raises(PolicyServerError, match="does not reply"):
        open_remote(f"openpi://{served.address}", *task_in("joint"))
    with openpi_server(lambda _: {}) as served:
        policy = open_remote(f"openvla://{served.address}", *task_in("ee_delta"))
        with pytest.raises(PolicyServerError, match="openvla://"):
            policy.act(observation())


@pytest.mark.parametrize(
    ("metadata", "kind", "said"),
    [
        ({}, PolicyServerError, "does not state on which data its policy was trained"),
        ({"action_space": "joint", "cameras": "front"}, PolicyServerError, "does not state"),
        (b"\xc1", PolicyServerError, "is not msgpack"),
        (b"\x93\x01\x02\x03", PolicyServerError, "is not a map (list)"),
        (
            {"action_space": "ee_delta", "cameras": []},
            ConfigError,
            "acts in ee_delta, the suite's actions are joint",
        ),
        (
            {"action_space": "joint", "cameras": ["top"]},
            ConfigError,
            "requires the camera top; the suite has front, side",
        ),
    ],
)
def test_a_policy_of_something_else_is_refused(metadata, kind, said):
    with openpi_server(lambda _: {}, metadata) as served, pytest.raises(kind) as caught:
        open_remote(f"openpi://{served.address}", *task_in("joint"))
    assert said in str(caught.value)


def test_a_checkpoint_of_several_datasets_is_told_whose_statistics_count():
    with openvla_server(lambda _: json_array(CHUNK[0])) as served:
        open_remote(f"openvla://{served.address}/opening", *task_in("ee_delta")).act(observation())
        assert served.asked[0]["unnorm_key"] == "opening"
    with pytest.raises(ConfigError, match="names a dataset"):
        open_remote("openpi://localhost:1/opening", *task_in("joint"))


def test_openvla_acts_in_deltas_and_knows_seven_joints():
    with pytest.raises(
        ConfigError, match="acts in ee_delta, the suite's actions are joint; pass --actions ee_delta"
    ):
        open_remote("openvla://localhost:1", *task_in("joint"))
    with pytest.raises(ConfigError, match="supports 7 joints, the arm has 8"):
        open_remote("openvla://localhost:1", *task_in("ee_delta", joints=8))


LIE = {**msgpack_array(CHUNK), b"shape": [5, 8]}
WORDS = {**msgpack_array(CHUNK), b"dtype": "|S4"}
OBJECTS = {**msgpack_array(CHUNK), b"dtype": "|O"}


def refuses_in_one_sentence(policy, where: str, said: str) -> None:
    with pytest.raises(PolicyServerError) as caught:
        policy.act(observation())
    assert str(caught.value).startswith(where)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ({}, "sent a reply without actions"),
        ({"actions": "none"}, "sent a reply without actions"),
        ({"actions": [[1.0], [1.0, 2.0]]}, "sent a reply without actions"),
        ({"actions": msgpack_array(CHUNK[:, :6])}, "sent actions of shape (5, 6); expected (N, 7)"),
        ({"actions": msgpack_array(CHUNK[None])}, "sent actions of shape (1, 5, 7)"),
        ({"actions": msgpack_array(CHUNK[:0])}, "sent actions of shape (0, 7)"),
        ({"actions": LIE}, "is not msgpack (an array of shape (5, 8) and float32 has 140 bytes)"),
        ({"actions": WORDS}, "is not msgpack (an array of |S4 is not numeric)"),
        ({"actions": OBJECTS}, "is not msgpack (an array of object is not numeric)"),
        ({"actions": {b"__ndarray__": True}}, "is not msgpack"),
        (b"\xc1", "is not msgpack"),
        (b"", "is not msgpack"),
        (b"\x90", "is not a map (list)"),
        ("Traceback:\n  File x\nKeyError: 'images'\n", "failed: KeyError: 'images'; see its log"),
        (None, "does not reply"),
        (bytes(policy_servers.MAX_ANSWER + 1), "does not reply"),
    ],
)
def test_wrong_answers_of_openpi_are_one_sentence(answer, said):
    with openpi_server(lambda _: answer) as served:
        policy = open_remote(f"openpi://{served.address}", *task_in("joint"))
        refuses_in_one_sentence(policy, f"openpi://{served.address}: ", said)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ("error", "failed with the message 'error'; see its log"),
        ({"detail": "no"}, "sent a reply without actions"),
        (None, "sent a reply without actions"),
        ([], "sent actions of shape (1, 0)"),
        (json_array(CHUNK[0, :6]), "sent actions of shape (1, 6); expected (N, 7)"),
        (
            {**json_array(CHUNK[0]), "shape": [8]},
            "is not JSON (an array of shape (8,) and float32 has 28 bytes)",
        ),
        ({**json_array(CHUNK[0]), "__numpy__": "?"}, "is not JSON"),
        ({**json_array(CHUNK[0]), "dtype": "secret"}, "is not JSON"),
        ({"__numpy__": ""}, "is not JSON"),
        (b"<html>", "is not JSON"),
        (b"[" * 100_000, "is not JSON"),
        (500, "replied with HTTP 500 to POST /act"),
    ],
)
def test_wrong_answers_of_openvla_are_one_sentence(answer, said):
    with openvla_server(lambda _: answer) as served:
        policy = open_remote(f"openvla://{served.address}", *task_in("ee_delta"))
        refuses_in_one_sentence(policy, f"openvla://{served.address}: ", said)


def test_a_server_that_thinks_for_ever_is_left(monkeypatch):
    monkeypatch.setattr(policy_servers, "ANSWER_S", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        policy = open_remote(f"openvla://127.0.0.1:{silent.getsockname()[1]}", *task_in("ee_delta"))
        with pytest.raises(PolicyServerError, match="does not reply"):
            policy.act(observation())
    monkeypatch.setattr(policy_servers, "CONNECT_S", 0.2)
    with (
        socket.create_server(("127.0.0.1", 0)) as silent,
        pytest.raises(PolicyServerError, match="does not reply"),
    ):
        open_remote(f"openpi://127.0.0.1:{silent.getsockname()[1]}", *task_in("joint"))


def test_a_server_that_goes_away_between_two_chunks_is_told():
    with openpi_server(lambda _: {"actions": msgpack_array(CHUNK[:1])}) as served:
        policy = open_remote(f"openpi://{served.address}", *task_in("joint"))
        policy.act(observation())
    with pytest.raises(PolicyServerError, match="does not reply"):
        policy.act(observation())


def test_connections_are_closed_with_the_policy(recwarn):
    with openpi_server(lambda _: {"actions": msgpack_array(CHUNK)}) as served:
        policy = open_remote(f"openpi://{served.address}", *task_in("joint"))
        policy.act(observation())
        assert not served.left.is_set()
        del policy
        gc.collect()
        assert served.left.wait(5)
    assert [str(item.message) for item in recwarn] == []


def test_missing_libraries_name_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "msgpack", None)
    with pytest.raises(BackendError, match=r"msgpack is not installed; pip install 'aomgen\[remote\]'"):
        open_remote("openpi://localhost:1", *task_in("joint"))


@given(
    data=st.one_of(st.binary(max_size=40), st.integers(), st.none()),
    dtype=st.one_of(
        st.sampled_from(["<f4", "|u1", "|O", ">i2", "V4", ""]), st.none(), st.integers(), st.text(max_size=4)
    ),
    shape=st.one_of(
        st.lists(st.one_of(st.integers(-3, 9), st.floats(), st.text(max_size=2)), max_size=3), st.none()
    ),
)
def test_damaged_arrays_are_refused_or_as_they_say(data, dtype, shape):
    try:
        array = read_array(data, dtype, shape)
    except (ValueError, TypeError):
        return
    assert array.shape == tuple(shape)
    assert array.tobytes() == data


def test_errors_survive_the_way_from_a_worker():
    error = PolicyServerError("openpi://h:1", "failed", "see its log")
    assert isinstance(error, AomgenError)
    kind, arguments = error.__reduce__()
    assert str(kind(*arguments)) == str(error)
