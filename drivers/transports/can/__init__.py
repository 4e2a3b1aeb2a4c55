"""The link over CAN: our own profile, in frames that a DBC file describes (docs/connect.md)."""
