"""Template of a study's page; a package so that it is installed with it."""
