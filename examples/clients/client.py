"""A PC program for C4G Open over UDP, from docs/wire.md: `python client.py PORT`.

It turns motor 1 by 0.1 revolutions and back, leaves open mode, and ends with the session (504).
It checks nothing: for a simulated controller only (`hil simulate`).
"""

import math
import socket
import struct
import sys

CYCLES = 1000
link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
link.bind(("0.0.0.0", int(sys.argv[1])))
n = k = 0  # axes; cycles with all of them open
start = last = 0.0
modes = [0]
while modes[0] != 504:
    packet, controller = link.recvfrom(2048)
    number = struct.unpack_from("<i", packet)[0]
    reply = bytearray(packet)  # sync, init, and while the drive is off: the same bytes
    struct.pack_into("<i", reply, 0, number % 0x7FFF + 1)
    if number == 10 and len(packet) == 1200:
        n = struct.unpack_from("<i", packet, 12)[0]
    elif n and len(packet) >= 12 + 36 * n:
        axes = [struct.unpack_from("<i8f", packet, 12 + 36 * i) for i in range(n)]
        modes = [axis[0] for axis in axes]
        if packet[4] == 5:  # drive on
            all_open = set(modes) == {4}
            if all_open and k == 0:
                start = axes[0][1]
            k += all_open
            turn = 0.05 * (1.0 - math.cos(2.0 * math.pi * min(k, CYCLES) / CYCLES))
            step, last = turn - last, turn
            leave = all_open and k > CYCLES and (k - CYCLES) % 100 == 1  # once, again if unheard
            struct.pack_into("<4B4B", reply, 4, leave, *[0] * 7)
            for i, (mode, target, *_) in enumerate(axes):
                moved = all_open and i == 0
                d1 = start + turn if moved else target if mode == 4 else 0.0
                d2 = step if moved else 0.0
                struct.pack_into("<i8f", reply, 12 + 36 * i, mode, d1, d2, *[0.0] * 6)
    link.sendto(reply, controller)
