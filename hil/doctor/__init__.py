"""What this PC can do: permissions, machine, network and disk looked at, latency measured.

Facts come through `check.System` (files below /proc and /sys, short commands); a judgement is a
function of those facts and gives one `check.Check`; `diagnosis.examine` does all of it. Nothing
here sends a packet to a controller or needs root.

This module imports nothing, so that a measuring process (`probe`) stays small.
"""
