"""What a recording may be other than stated, and how certain that is."""
