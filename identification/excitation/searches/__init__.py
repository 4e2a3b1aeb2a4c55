"""Searching among many motions for the one that excites the parameters best.

`Problem` says which motions and how good they are, `Population` scores them in processes of
their own, `search` decides what is scored next, `Journal` keeps what is known.
"""
