"""The link over CAN: a profile of our own in frames that a DBC file describes; see docs/connect.md."""
