"""`[simulation]` of the cell file: what the simulated robot really is."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from .fields import NonNegative, Number, Positive, Table, Vector, Whole


class SimulatedDriveTable(Table):
    """`[simulation.drive_train]`: gears of the simulated robot, known from elsewhere.

    What is left out is as in `[drive_train]`, which a mistake there then goes for as well.
    """

    gear_ratio: Vector | None = Field(
        default=None, description="signed motor revolutions per joint revolution, none of them 0"
    )
    joint_sign: list[Literal[-1, 1]] | None = Field(
        default=None, description="1 or -1: sense of the controller's angle against the URDF's"
    )
    joint_offset_deg: Vector | None = Field(
        default=None, description="controller angle at URDF angle 0, in degrees, one per joint"
    )
    k54: Number | None = Field(default=None, description="wrist coupling of axis 4 into motor 5")
    k64: Number | None = Field(default=None, description="wrist coupling of axis 4 into motor 6")
    k65: Number | None = Field(default=None, description="wrist coupling of axis 5 into motor 6")

    @model_validator(mode="after")
    def _nonzero(self) -> SimulatedDriveTable:
        for joint, value in enumerate(self.gear_ratio or (), 1):
            if value == 0:
                raise ValueError(
                    f"gear_ratio of joint {joint} is 0; "
                    "give signed motor revolutions per joint revolution"
                )
        return self


class SimulationTable(Table):
    """`[simulation]`: what the simulated cell really is; ignored on hardware."""

    seed: Whole = Field(default=1, ge=0, description="one seed is one bit-identical run")
    initial_deg: Vector = Field(
        description="where the simulated arm stands at first, degrees, in the frame of [limits]"
    )
    inertia_scale: list[Positive] = Field(
        default_factory=list,
        description="planted truth: mass, first moment and inertia of the link that each joint "
        "moves over those of the URDF, or nothing where it is right",
    )
    rotor_inertia: list[NonNegative] = Field(description="planted truth, kg·m² at the joint")
    coulomb: Vector = Field(description="planted truth, N·m, one per joint")
    viscous: Vector = Field(description="planted truth, N·m·s/rad, one per joint")
    third: Vector = Field(description="planted truth of the third friction term, one per joint")
    current_noise: NonNegative = Field(description="A rms about the target current, each motor")
    current_resolution: NonNegative = Field(description="step of the target current, A")
    torque_ripple: NonNegative = Field(
        default=0.0, description="size of an unmodelled effect: share of the Coulomb torque"
    )
    friction_drift: Annotated[Number, Field(ge=0, lt=1)] = Field(
        default=0.0,
        description="size of an unmodelled effect: fall of the friction from cold to hot",
    )
    elasticity: list[NonNegative] = Field(
        default_factory=list,
        description="size of an unmodelled effect: rad/(N·m) of each gear, or nothing",
    )
    delay: NonNegative = Field(
        default=0.0,
        description="size of an unmodelled effect: later effect of the target current, s",
    )
    drive_train: SimulatedDriveTable = Field(
        default=SimulatedDriveTable(),
        description="a table of what is known of its gears independently of [drive_train]",
    )
