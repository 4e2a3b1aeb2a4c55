"""What evidence says about each subject of a verdict, and the findings on it in words.

A class of facts is built from :class:`~identification.validation.evidence.Evidence` and
:class:`~identification.validation.finding.Thresholds` by its method `of`, which returns None where
that evidence was not gathered. :mod:`identification.validation.verdict` has them in order.
"""
