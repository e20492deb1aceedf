"""Laws of the small policy, run by test_policy.py in .venv-policy: prints what failed, nothing else."""

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot_policy_aomgen.configuration_small_act import SmallACTConfig
from lerobot_policy_aomgen.modeling_small_act import SmallACTPolicy

CAMERA = "observation.images.front"


def policy(actions: int = 7, **settings: object) -> SmallACTPolicy:
    torch.manual_seed(0)
    config = SmallACTConfig(
        device="cpu",
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (7,)),
            CAMERA: PolicyFeature(FeatureType.VISUAL, (3, 48, 64)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (actions,))},
        **settings,
    )
    return SmallACTPolicy(config).eval()


def batch(count: int = 3, chunk: int = 50, seed: int = 1) -> dict[str, torch.Tensor]:
    rng = torch.Generator().manual_seed(seed)
    return {
        "observation.state": torch.randn(count, 7, generator=rng),
        CAMERA: torch.randn(count, 3, 48, 64, generator=rng),
        "action": torch.randn(count, chunk, 7, generator=rng),
        "action_is_pad": torch.zeros(count, chunk, dtype=torch.bool),
    }


def check(holds: object, law: str) -> None:
    if not bool(holds):
        print(f"failed: {law}")


with torch.no_grad():
    made, seen = policy(), batch()
    said = made.predict_action_chunk(seen)
    check(said.shape == (3, 50, 7), "a chunk of actions for every observation")
    check(torch.equal(said, made.predict_action_chunk(seen)), "without training nothing is random")

    # Only what lies inside an episode teaches.
    cut = seen | {"action_is_pad": torch.arange(50).expand(3, -1) >= 20}
    beyond = cut | {"action": cut["action"] + 100.0 * cut["action_is_pad"][..., None]}
    torch.manual_seed(2)
    first = made(cut)[0]
    torch.manual_seed(2)
    check(torch.equal(first, made(beyond)[0]), "what lies beyond an episode's end teaches nothing")

    # The first look is done as it is said; the second goes over from what was said before.
    made.reset()
    later = batch(seed=9)
    done = [made.select_action(seen) for _ in range(5)] + [made.select_action(later) for _ in range(5)]
    again = made.predict_action_chunk(later)
    check(torch.equal(torch.stack(done[:5], 1), said[:, :5]), "the first chunk is done as it is said")
    share = torch.arange(1, 6)[:, None] / 6
    blended = share * again[:, :5] + (1 - share) * said[:, 5:10]
    check(torch.allclose(torch.stack(done[5:], 1), blended), "the next one goes over from the last")
    made.reset()
    check(torch.equal(made.select_action(later), again[:, 0]), "a new trial knows nothing of the last")

    # Offsets from the state: with an untrained head that says nothing, the arm stays.
    still = policy()
    still.model.action.weight.zero_()
    still.model.action.bias.zero_()
    held = still.predict_action_chunk(seen)
    check(
        torch.allclose(held, seen["observation.state"][:, None].expand_as(held)),
        "joints are offsets from the state",
    )

made = policy()
made.train()
loss = made(seen)[0]
loss.backward()
check(all(p.grad is not None for p in made.parameters()), "everything is trained")
check(sum(p.numel() for p in made.parameters()) <= 3_000_000, "at most 3 million parameters")
try:
    policy(actions=8)
    print("failed: poses as offsets from joints are refused")
except ValueError as error:
    check("joint_offsets=false" in str(error), "the way out is named")
check(
    policy(actions=8, joint_offsets=False).predict_action_chunk(batch()).shape == (3, 50, 8),
    "poses are learned",
)
