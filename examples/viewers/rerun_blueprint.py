"""Write `arm.rbl`: `rerun arm.rbl runs/demo/archives/validation_000_a1.mcap` opens both.

Predicted and residual torque are in the copies of `hil identify --annotate`.
Needs `pip install rerun-sdk`; hil itself does not.
"""

from __future__ import annotations

import rerun.blueprint as rrb

PLOTS = {
    "position, velocity and torque": "/joint_states",
    "commanded": "/joint_states_commanded",
    "predicted torque": "/joint_states_predicted",
    "residual torque": "/joint_states_residual",
}
EVENTS = "/hil/events"
ARM = "/robot_description"

plots = [
    rrb.TimeSeriesView(name=name, origin=topic, contents=f"{topic}/**")
    for name, topic in PLOTS.items()
]
arm = rrb.Spatial3DView(name="arm", origin="/", contents=f"{ARM}/**")
events = rrb.TextLogView(name="events", origin=EVENTS, contents=f"{EVENTS}/**")
layout = rrb.Horizontal(rrb.Vertical(arm, events), rrb.Vertical(*plots))
rrb.Blueprint(layout, collapse_panels=True).save("hil", "arm.rbl")
print("written: arm.rbl")
