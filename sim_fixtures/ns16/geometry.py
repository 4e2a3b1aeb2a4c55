"""Geometry of the NS 16: Denavit-Hartenberg table and controller angles.

Standard DH, T_i = Rz(q_i) Tz(d_i) Tx(a_i) Rx(alpha_i). Link frame i has the axes of DH frame i and
its origin at O_{i-1}, a point of the joint axis, to which the parameters of Table 2 refer.

Table 2 determines a_1, a_2, a_3, d_4 and the twists alpha_2 ... alpha_5, not the sign of alpha_1
(a mirror image has the same table), d_1, d_6, the zero positions and the directions of rotation.
Chosen are alpha_1 = -90 deg with z0 up, d_1 and d_6 of the data sheet, and published directions.
With the forearm level, the elbow offset a_3 then puts the forearm *below* the elbow axis and home
turns the flange up, the mirror image of the real arm; dynamics and identification are the same.

At controller angles of zero, links 2 and 3 are upright; at -90 deg of axis 3 the forearm is level.
"""

from __future__ import annotations

from typing import Final

A: Final = (0.300, 0.700, 0.185, 0.0, 0.0, 0.0)
"""Link lengths a_i [m]."""

D: Final = (0.600, 0.0, 0.0, -0.624, 0.0, 0.135)
"""Link offsets d_i [m]; the first and the last are not in Table 2 but on the data sheet."""

ALPHA_QUARTER_TURNS: Final = (-1, 0, -1, -1, -1, 0)
"""Twists alpha_i in units of 90 deg, so that sines and cosines are exact."""

JOINT_SIGN: Final = (-1, 1, -1, -1, 1, -1)
"""Controller angle = sign * DH angle + offset."""

JOINT_OFFSET_DEG: Final = (0.0, 90.0, 90.0, 0.0, 0.0, 0.0)

LOWER_DEG: Final = (-180.0, -50.0, -170.0, -360.0, -120.0, -360.0)
"""Controller angles allowed by both the catalogue and the published URDF."""

UPPER_DEG: Final = (180.0, 95.0, 110.0, 360.0, 120.0, 360.0)

VELOCITY_DEG: Final = (155.0, 155.0, 170.0, 360.0, 350.0, 550.0)
"""Maximum speeds [deg/s]; assumed."""

HOME_DEG: Final = (0.0, 0.0, -90.0, 0.0, 90.0, 0.0)
"""Home posture of the manufacturer, controller angles."""
