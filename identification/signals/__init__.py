"""From a recording to signals: its clock."""
