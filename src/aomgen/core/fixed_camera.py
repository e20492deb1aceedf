"""A fixed camera of the demonstration: its pose, its clock, and how they were found."""

from dataclasses import dataclass, field

from aomgen.core.camera import Camera
from aomgen.core.clock import Clock
from aomgen.errors import SyncError


@dataclass(frozen=True, slots=True, kw_only=True)
class FixedCamera:
    """One fixed camera in the world, and its video's clock.

    Attributes:
        camera: Optics and pose, world frame.
        clock: Of its video against the joint log, None when it was refused.
        refusal: Where, problem and remedy of the refused clock; empty otherwise.
        note: How the pose was found, in words.
        trusted: Whether everything that was known of the camera agrees.
        figures: Metrics by name.
    """

    camera: Camera
    clock: Clock | None
    refusal: tuple[str, ...] = ()
    note: str = ""
    trusted: bool = True
    figures: dict[str, float] = field(default_factory=dict)

    def require_clock(self) -> Clock:
        """The clock.

        Raises:
            SyncError: It was refused; the reason is the one found then.
        """
        if self.clock is None:
            raise SyncError(*self.refusal)
        return self.clock

    def summary(self) -> dict[str, object]:
        """Metrics for the manifest."""
        clock = {} if self.clock is None else {"offset_s": self.clock.offset_s, "sd_s": self.clock.sd_s}
        return {"note": self.note, "clock": clock or "; ".join(self.refusal), **self.figures}

    def warnings(self, name: str) -> list[str]:
        """Sentences for the user."""
        found = [] if self.trusted else [f"camera '{name}' {self.note}"]
        return found + ([f"camera '{name}': {'; '.join(self.refusal)}"] if self.refusal else [])
