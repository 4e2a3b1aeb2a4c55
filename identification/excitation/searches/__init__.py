"""Searches for the best excitation.

`Problem` defines motions and their scores, `Population` scores them in child processes, `search`
chooses what to score next, `Journal` stores scores.
"""
