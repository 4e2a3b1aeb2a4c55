"""The link to a controller, real or simulated; single motions and recordings over it."""
