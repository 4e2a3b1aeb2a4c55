"""Check of a PC: permissions, processor, link, disk and latency.

It sends nothing to a controller and needs no root. This module imports nothing, so that a measuring
process (`probe`) stays small.
"""
