"""The ros2msg texts that an archive carries, each with all its dependencies.

They are the one description of the messages: writer and reader compute their byte layouts from
them, and foreign programs decode with them.
"""

from __future__ import annotations

JOINT_STATE = "sensor_msgs/msg/JointState"
LOG = "rcl_interfaces/msg/Log"
PACKET = "hil_msgs/msg/Packet"

_SEPARATOR = "=" * 80
_TIME = """\
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_HEADER = """\
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
"""

_JOINT_STATE = """\
# Position [rad], velocity [rad/s] and effort [N.m] of the joints in `name`.
# An array is as long as `name`, or empty when the quantity is not known.
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
"""

_CYCLE = """\
# One cycle of the controller link as the PC saw it. Joints in the order of the archive's
# joint_names. Angles are those of the robot description (URDF); SI units.
# header.stamp is the time since the controller's initialisation: cycle * period.
std_msgs/Header header
int64 cycle                     # cycles of the controller since its initialisation
float64 arrival                 # s, clock of the PC, for diagnosis only
float64[{n}] target_position      # rad, set-point inside the controller
float64[{n}] target_velocity      # rad/s, set-point inside the controller
float64[{n}] position             # rad, measured
float64[{n}] velocity             # rad/s, measured
float64[{n}] torque               # N.m, joint side, from target_current; NaN when unknown
float64[{n}] target_current       # A, motor side, demanded by the controller's speed loop
float64[{n}] model_current        # A, motor side, of the controller's dynamic model (extra 1)
float64[{n}] diagonal_inertia     # kg.m2, as the controller sends it (extra 2)
float64[{n}] extra3               # as the controller sends it (extra 3)
float64[{n}] commanded_position   # rad, this packet's answer; NaN where no set-point was sent
float64[{n}] commanded_velocity   # rad/s, this packet's answer; NaN where no set-point was sent
int32[{n}] mode                   # mode of each axis, as on the wire
int32 number                    # sequence number of the packet, as on the wire
int32 gap                       # packets lost just before this one
int32 interval                  # index of the interval of open mode
uint8 state                     # state of the session
uint8 status                    # status byte of the arm, as on the wire
uint16[8] age                   # cycles since the oldest joint value of each of these was sent:
                                # target_position, target_velocity, position, velocity,
                                # target_current, model_current, diagonal_inertia, extra3
"""

_MOTOR_CURRENT = """\
# Measured motor currents of a foreign recording, motor side.
std_msgs/Header header
float64[{n}] motor_current        # A
"""

_PACKET = """\
# One packet of the controller link, byte by byte, in the order in which the PC received and sent.
# header.stamp is that of the cycle in /hil/cycle to which it belongs.
std_msgs/Header header
int64 cycle                     # cycles of the controller since its initialisation
float64 time                    # s, clock of the PC: when it arrived or was sent
uint16 length                   # bytes
uint8 sent                      # 1: sent by the PC, 0: received by it
uint8[{size}] data               # the packet, then zeros
"""

_LOG = """\
byte DEBUG=10
byte INFO=20
byte WARN=30
byte ERROR=40
byte FATAL=50
builtin_interfaces/Time stamp   # time since the controller's initialisation
uint8 level
string name                     # kind of event
string msg                      # one line of text; a second line, if any, is one JSON object
string file
string function
uint32 line
"""


def _text(message: str, *dependencies: str) -> str:
    return "".join([message, *(f"{_SEPARATOR}\n{part}" for part in dependencies)])


def joint_state() -> str:
    """The definition of sensor_msgs/msg/JointState."""
    return _text(_JOINT_STATE, _HEADER, _TIME)


def log() -> str:
    """The definition of rcl_interfaces/msg/Log."""
    return _text(_LOG, _TIME)


def cycle_name(n_joints: int) -> str:
    """Name of the cycle message for so many joints."""
    return f"hil_msgs/msg/Cycle{n_joints}"


def cycle(n_joints: int) -> str:
    """The definition of the cycle message for so many joints."""
    return _text(_CYCLE.format(n=n_joints), _HEADER, _TIME)


def packet(size: int) -> str:
    """The definition of the message that holds a raw packet of up to so many bytes."""
    return _text(_PACKET.format(size=size), _HEADER, _TIME)


def motor_current_name(n_joints: int) -> str:
    """Name of the motor current message for so many joints."""
    return f"hil_msgs/msg/MotorCurrent{n_joints}"


def motor_current(n_joints: int) -> str:
    """The definition of the motor current message for so many joints."""
    return _text(_MOTOR_CURRENT.format(n=n_joints), _HEADER, _TIME)
