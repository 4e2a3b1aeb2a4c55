"""A robot of several arms."""

from __future__ import annotations

from pathlib import Path


def chain(side: str, joints: int, parent: str) -> str:
    parts = []
    for number in range(1, joints + 1):
        parts.append(
            f"<link name='{side}_l{number}'><inertial><mass value='1'/><origin xyz='0 0 0.2'/>"
            "<inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' iyz='0'/></inertial></link>"
            f"<joint name='{side}_j{number}' type='revolute'><parent link='{parent}'/>"
            f"<child link='{side}_l{number}'/><axis xyz='0 1 0'/><origin xyz='0 0 0.4'/>"
            "<limit lower='-3' upper='3' effort='90' velocity='9'/></joint>"
        )
        parent = f"{side}_l{number}"
    return "".join(parts)


def robot_of_arms(folder: Path, *arms: tuple[str, int]) -> Path:
    """Its arms hang on a torso that turns, with their sides and numbers of joints."""
    torso = chain("torso", 1, "base")
    parts = "".join(chain(side, joints, "torso_l1") for side, joints in arms)
    path = folder / "robot.urdf"
    path.write_text(f"<robot name='two'><link name='base'/>{torso}{parts}</robot>")
    return path
