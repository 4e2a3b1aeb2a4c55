"""Templates of pages that show pictures."""
