"""Functions from evidence and limits to findings, by subject.

A function returns None, or nothing, where its evidence was not gathered or says nothing.
`identification.validation.findings.table` lists them in order, and
`identification.validation.finding_messages` words what they return.
"""
