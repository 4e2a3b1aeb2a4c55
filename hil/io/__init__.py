"""Files and folders: digests, locks, atomic writes."""
