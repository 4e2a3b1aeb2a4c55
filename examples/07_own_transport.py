"""Your own link: an object with seven methods that carries packets, here a pipe.

The controller runs in another process and waits for each reply, so that time is virtual. Prints the
outcome of the motion and the number of packets; the picture is its archive. `drivers.Transport`
defines the methods; a link in real time runs in the exchange process
(`drivers.exchange`), opened there from a `TransportSpec`.
"""

from multiprocessing import Pipe, get_context
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory

from drivers import CycleRing, Guard, Session, TransportClosed
from hil import Cell, plan_move, send, simulated_controller, stop_on_interrupt
from hil.campaign import VirtualLink
from hil.plots import save
from hil.plots.archive_view import draw_archive, view_of

CELL = "sim_fixtures/ns16/cell.toml"
PICTURE = Path("runs/examples/07_own_transport.png")
REPLY_TIMEOUT = 60.0  # s that the controller waits for a reply


class PipeTransport:
    """One message is one packet; the controller sends the next one after the reply."""

    def __init__(self, end: Connection, period: float) -> None:
        self.end = end
        self.period = period
        self.packets = 0

    @property
    def now(self) -> float:
        """Seconds since the first packet."""
        return self.packets * self.period

    def receive(self, timeout: float) -> bytes | None:
        """Return the next packet, None after `timeout` seconds."""
        try:
            packet = self.end.recv_bytes() if self.end.poll(timeout) else None
        except (EOFError, OSError) as error:
            raise TransportClosed("the controller closed the pipe") from error
        self.packets += packet is not None
        return packet

    def send(self, packet: bytes) -> None:
        """Send a reply."""
        try:
            self.end.send_bytes(packet)
        except OSError as error:
            raise TransportClosed("the controller closed the pipe") from error

    def rejected(self) -> dict[str, int]:
        """Return counts of discarded packets: none."""
        return {}

    def forget_peer(self) -> None:
        """Do nothing: a pipe has one peer."""

    def close(self) -> None:
        """Close the pipe."""
        self.end.close()


def controller(end: Connection) -> None:
    """Run the controller: a packet, its reply, the next packet."""
    arm = simulated_controller(Cell.load(CELL))
    while (packet := arm.next_packet()) is not None:
        if packet:
            end.send_bytes(packet)
        arm.accept(end.recv_bytes() if packet and end.poll(REPLY_TIMEOUT) else None)


def main() -> None:
    """Connect through the pipe and go home."""
    cell = Cell.load(CELL)
    (pc_end, controller_end) = Pipe()
    get_context("fork").Process(target=controller, args=(controller_end,), daemon=True).start()
    ring = CycleRing(len(cell.joint_names), capacity=1000)
    guard = Guard(cell.guard_limits, cell.period)
    session = Session(cell.drive_train, guard, ring, **cell.session_settings())
    transport = PipeTransport(pc_end, cell.period)
    link = VirtualLink(transport, session, ring, cell)
    with TemporaryDirectory() as folder, stop_on_interrupt() as stop:
        archive = Path(folder) / "move_000_a1.mcap"
        move = plan_move(cell, link.connect(stop), cell.home)
        print(send(move, cell, link, archive, stop=stop).outcome, transport.packets, "packets")
        PICTURE.parent.mkdir(parents=True, exist_ok=True)
        save(draw_archive(view_of(archive, joints=("1",))), PICTURE)


if __name__ == "__main__":
    main()
