"""The PC's end of a Universal Robots controller: what it sends, read without commanding anything.

`rtde` is the protocol of its real-time outputs, `reader` reads every frame of them, `outputs` names
what is recorded, `cycles` makes records of it, and `identity` asks the arm who it is.
"""
