"""Small robot descriptions that tests write, damage and read."""

# Three hinges, two of them with parallel axes, and a gripper whose fingers slide along y.
URDF = """<?xml version="1.0"?>
<robot name="small">
  <link name="base">{base}</link>
  {links}
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 0.1"/><axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="50" velocity="2"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/>
    <origin xyz="0 0 0.3"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="50" velocity="2"/></joint>
  <joint name="wrist" type="revolute"><parent link="fore"/><child link="palm"/>
    <origin xyz="0 0 0.3"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="50" velocity="2"/></joint>
  <joint name="slide_a" type="prismatic"><parent link="palm"/><child link="finger_a"/>
    <origin xyz="0 -0.005 0.03"/><axis xyz="0 -1 0"/>
    <limit lower="0" upper="{stroke}" effort="50" velocity="1"/></joint>
  <joint name="slide_b" type="prismatic"><parent link="palm"/><child link="finger_b"/>
    <origin xyz="0 0.005 0.03"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="{stroke}" effort="50" velocity="1"/>{mimic}</joint>
</robot>
"""
BOX = '<{kind}><origin xyz="{xyz}"/><geometry><box size="{size}"/></geometry></{kind}>'
INERTIA = (
    '<inertial><mass value="0.5"/>'
    '<inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial>'
)
MIMIC = '<mimic joint="slide_a"/>'
STROKE_M = 0.04
SHAPES = {
    "upper": ("0 0 0.15", "0.06 0.06 0.28"),
    "fore": ("0 0 0.15", "0.05 0.05 0.28"),
    "palm": ("0 0 0.0", "0.04 0.12 0.04"),
    "finger_a": ("0 -0.005 0.03", "0.02 0.01 0.06"),
    "finger_b": ("0 0.005 0.03", "0.02 0.01 0.06"),
}


def _shape(xyz: str, size: str) -> str:
    return "".join(BOX.format(kind=kind, xyz=xyz, size=size) for kind in ("visual", "collision"))


def urdf_text(*, mimic: str = MIMIC, stroke: float = STROKE_M, base: str | None = None) -> str:
    """Return the URDF of the small robot; `base` replaces the base link's shapes."""
    links = "".join(f'<link name="{name}">{INERTIA}{_shape(*shape)}</link>' for name, shape in SHAPES.items())
    base = base if base is not None else _shape("0 0 0.05", "0.1 0.1 0.1")
    return URDF.format(links=links, base=base, mimic=mimic, stroke=stroke)
