"""What the files of results contain: identification, rollout, and series of the figures."""
