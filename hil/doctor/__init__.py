"""Check of a PC: permissions, computer, network, disk and latency.

Facts are read by `check.System` (files below /proc and /sys, short commands); each check is a
function of facts that returns a `check.Check`; `diagnosis.examine` runs all. Nothing here sends a
packet to a controller or needs root.

This module imports nothing, so that a measuring process (`probe`) stays small.
"""
