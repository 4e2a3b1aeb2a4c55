"""Sentences of the product that tests assert: reworded here, and nowhere else.

Short fragments and texts with figures stand in the tests.
"""

from __future__ import annotations

from typing import Final

ALL_TORQUES_OPPOSITE: Final = "The model must not be relied on: all torques have the opposite sign"
BY_MASSES_OF_URDF: Final = "in proportion to the masses of the URDF only"
CANNOT_HOLD: Final = "held, which this motion cannot: it was stopped instead"
CHECK_UNIT_SIGN_ZERO: Final = "check unit, sign and zero in the column map"
COLLISION_IN_MEAN_POSTURE: Final = "in the mean posture of the sines: collision of"
ENTER_THE_MAKERS: Final = "not determined: enter the maker's, or record faster motion"
EVERY_ROW_LEAVES_LIMITS: Final = "as mapped, every row leaves the limits of the URDF"
FRICTION_GROWS: Final = "friction that grows with the transmitted torque, a share fl of it"
HELD_OR_SLOWED: Final = "rejected and left out: it was held or slowed"
HOLDS_NO_EXCITATION: Final = "alone could not be used: it holds no excitation"
LOAD_AT_ORIGIN: Final = "the load's centre of mass is assumed at the origin"
MERGED_MESSAGES: Final = "merged from messages of their own, with the same stamps"
MISSED_IN_IT_ONLY: Final = "packets were missed in it, and none in those"
MOTION_NOT_AT_FAULT: Final = (
    "the motion is not at fault; correct delay and elasticity in [simulation]"
)
NONE_AS_DEGREES: Final = 'as degrees read as radians, none would: write [position] unit = "deg"'
NOTHING_WAS_SENT: Final = "went off before the motion began; nothing was sent"
NOT_IN_REPORT: Final = "not in report.html: the arm was identified for this rollout"
PAYLOAD_TO_BE_WEIGHED: Final = "was recorded with a payload that was to be weighed"
PREDICTS_SAME_MOTION: Final = "The model predicts the rest of the same motion well"
RESIDUAL_DECREASES: Final = "the residual decreases up to the longest delay tested"
SET_BY_FOLLOWING_ERROR: Final = ", set by [drive_train] following_error, or the controller"
TORQUES_TOO_SLOW_OR_NOISY: Final = "the torques change too slowly, or are too noisy"
WARM_THE_ARM_UP: Final = "warm the arm up by moving it before recording"
