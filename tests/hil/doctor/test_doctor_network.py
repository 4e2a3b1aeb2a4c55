"""Judgements of routes, cards, ports and buses: files instead of /proc and /sys."""

from __future__ import annotations

import errno

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.doctor import link as port
from hil.doctor import link as route
from hil.doctor.check import Answer, Check, Status
from hil.doctor.link import CanLink, can_check, coalescing, device_check, firewall, network_checks
from tests.hil.doctor.conftest import Tree

ROUTES = """Iface\tDestination\tGateway \tFlags\tRefCnt\tUse\tMetric\tMask\t\tMTU\tWindow\tIRTT
eth0\t00000000\t010200C0\t0003\t0\t0\t0\t00000000\t0\t0\t0
eth1\t000C020A\t00000000\t0001\t0\t0\t100\t00FFFFFF\t0\t0\t0
eth2\t000C020A\t00000000\t0001\t0\t0\t200\t00FFFFFF\t0\t0\t0
"""
ARP = "IP address       HW type     Flags       HW address            Mask     Device\n"
C4G = "10.2.12.150"


def card(**files: str) -> dict[str, str]:
    given = {"operstate": "up", "carrier": "1", "speed": "1000", "duplex": "full"} | files
    return {f"/sys/class/net/eth1/{name}": text for name, text in given.items()}


def by_name(checks: list[Check]) -> dict[str, Check]:
    return {check.name: check for check in checks}


def test_the_longest_prefix_and_then_the_lowest_metric_carries_the_route(tree: Tree) -> None:
    system = tree.write({"/proc/net/route": ROUTES}).system()
    assert route.route_to(C4G, system) == route.Route("eth1", None)
    assert route.route_to("10.2.13.1", system) == route.Route("eth0", "192.0.2.1", True)
    assert route.route_to("127.0.0.1", system) == route.Route("lo", None)


def test_a_controller_behind_a_gateway_is_bad_and_none_at_all_too(tree: Tree) -> None:
    tree.write({"/proc/net/route": ROUTES.replace("eth1", "eth9").replace("000C020A", "00636363")})
    checks = by_name(network_checks(C4G, 1000, C4G, tree.system()))
    assert checks["route to the controller"].status is Status.BAD
    assert "192.0.2.1" in checks["route to the controller"].found
    assert "10.2.12.149/24" in checks["route to the controller"].remedy[0]
    tree.write({"/proc/net/route": ""})
    checks = by_name(network_checks(C4G, 1000, C4G, tree.system()))
    assert checks["route to the controller"].found == f"none to {C4G}"


def test_an_own_address_is_loopback_and_needs_no_card(tree: Tree) -> None:
    trie = "Local:\n  +-- 10.2.12.0/24\n     |-- 10.2.12.150\n        /32 host LOCAL\n"
    tree.write({"/proc/net/fib_trie": trie, "/proc/net/route": ROUTES})
    checks = network_checks(C4G, 1000, C4G, tree.system())
    assert {check.status for check in checks} == {Status.OK}


def test_a_name_is_looked_up_in_the_hosts_file_and_nowhere_else(tree: Tree) -> None:
    tree.write({"/etc/hosts": "127.0.0.1 localhost\n10.2.12.150 c4g robot # ours\n"})
    assert route.address_of("robot", tree.system()) == C4G
    assert route.address_of("ours", tree.system()) is None
    check = network_checks("elsewhere.invalid", 1000, None, tree.system())[0]
    assert check.status is Status.BAD


@pytest.mark.parametrize(
    ("files", "status", "word"),
    [
        ({}, Status.OK, "1000 Mbit/s"),
        ({"operstate": "down", "carrier": "0"}, Status.BAD, "no carrier"),
        ({"duplex": "half"}, Status.BAD, "half"),
        ({"speed": "10"}, Status.BAD, "10 Mbit/s"),
        ({"speed": "-1", "duplex": "unknown"}, Status.OK, "speed not stated"),
        ({"speed": "gibberish"}, Status.OK, "speed not stated"),
        ({"wireless/x": ""}, Status.BAD, "wireless"),
    ],
)
def test_the_card_has_to_be_up_wired_and_fast(
    tree: Tree, files: dict[str, str], status: Status, word: str
) -> None:
    check = device_check("eth1", tree.write(card(**files)).system())
    assert check.status is status
    assert word in check.found


def test_a_card_shared_with_the_default_route_is_warned_of(tree: Tree) -> None:
    tree.write(card() | {"/proc/net/route": ROUTES.replace("eth0", "eth1")})
    assert device_check("eth1", tree.system()).status is Status.WARN


def test_a_card_that_is_not_there_is_bad(tree: Tree) -> None:
    assert device_check("eth7", tree.system()).status is Status.BAD


@pytest.mark.parametrize(
    ("line", "status", "word"),
    [
        ("10.2.12.150 0x1 0x6 00:04:50:00:00:01 * eth1", Status.OK, "permanent"),
        ("10.2.12.150 0x1 0x2 00:04:50:00:00:01 * eth1", Status.WARN, "will expire"),
        ("10.2.12.150 0x1 0x0 00:00:00:00:00:00 * eth1", Status.WARN, "none"),
        ("10.2.12.150 0x1 0x6 00:04:50:00:00:01 * eth2", Status.WARN, "none"),
        ("10.2.12.150 0x1 what? 00:04:50:00:00:01 * eth1", Status.WARN, "none"),
        ("", Status.WARN, "none"),
    ],
)
def test_a_permanent_arp_entry_is_wanted(tree: Tree, line: str, status: Status, word: str) -> None:
    tree.write(card() | {"/proc/net/route": ROUTES, "/proc/net/arp": ARP + line + "\n"})
    check = by_name(network_checks(C4G, 1000, C4G, tree.system()))["ARP entry of the controller"]
    assert check.status is status
    assert word in check.found
    if status is Status.WARN:
        assert check.remedy[0].startswith("sudo ip neigh replace 10.2.12.150 lladdr ")


@pytest.mark.parametrize(
    ("answer", "status"),
    [
        (Answer(0, "Adaptive RX: off  TX: off\nrx-usecs: 0\n"), Status.OK),
        (Answer(0, "Adaptive RX: on  TX: on\nrx-usecs: 3\n"), Status.WARN),
        (Answer(0, "rx-usecs: 200\n"), Status.WARN),
        (Answer(1, "", "netlink error: Operation not supported"), Status.OK),
        (Answer(1, "", "netlink error: Operation not permitted"), Status.UNKNOWN),
        (Answer(0, "\x00nonsense"), Status.OK),
    ],
)
def test_a_card_that_gathers_packets_is_warned_of(
    tree: Tree, answer: Answer, status: Status
) -> None:
    check = coalescing("eth1", tree.system(ethtool=answer))
    assert check is not None
    assert check.status is status


def test_without_ethtool_coalescing_is_unknown_and_the_command_is_given(tree: Tree) -> None:
    check = coalescing("eth1", tree.system())
    assert check is not None
    assert check.status is Status.UNKNOWN
    assert "ethtool -c eth1" in check.remedy


NFT_DROP = "table inet filter { chain input { type filter hook input priority 0; policy drop; } }"
NFT_OPEN = "table inet filter { chain input { type filter hook input priority 0; policy accept; } }"
UFW = "-P INPUT ACCEPT\n-A INPUT -j ufw-input\n-A ufw-input -p udp -j DROP\n"
NFT_NESTED = """table inet filter { chain input { type filter hook input priority 0; policy accept;
    ct state vmap { established : accept }
    udp dport 1000 drop } }"""


@pytest.mark.parametrize(
    ("commands", "status"),
    [
        ({"nft": Answer(0, "")}, Status.OK),
        ({"nft": Answer(0, NFT_OPEN)}, Status.OK),
        ({"nft": Answer(0, NFT_DROP)}, Status.WARN),
        ({"iptables": Answer(0, "-P INPUT ACCEPT\n")}, Status.OK),
        ({"iptables": Answer(0, "-P INPUT DROP\n")}, Status.WARN),
        ({"iptables": Answer(0, UFW)}, Status.WARN),
        ({"iptables": Answer(0, UFW.replace("DROP", "ACCEPT"))}, Status.OK),
        ({"nft": Answer(0, NFT_NESTED)}, Status.WARN),
        ({"nft": Answer(1, "", "Operation not permitted (you must be root)")}, Status.UNKNOWN),
        ({"nft": Answer(0, ""), "iptables": Answer(4, "", "Permission denied")}, Status.UNKNOWN),
    ],
)
def test_a_firewall_is_judged_only_as_far_as_it_can_be_read(
    tree: Tree, commands: dict[str, Answer], status: Status
) -> None:
    assert firewall(C4G, 1000, tree.system(**commands)).status is status


def test_without_tools_a_loaded_filter_is_unknown_and_none_is_fine(tree: Tree) -> None:
    assert firewall(C4G, 1000, tree.system()).status is Status.OK
    tree.write({"/proc/net/netfilter/nf_log": ""})
    assert firewall(C4G, 1000, tree.system()).status is Status.UNKNOWN


@given(text=st.text())
def test_nonsense_in_the_kernels_tables_is_no_route_and_no_neighbour(
    tmp_path_factory: pytest.TempPathFactory, text: str
) -> None:
    tree = Tree(tmp_path_factory.mktemp("nonsense"))
    head = "header\n"
    tree.write({"/proc/net/route": head + text, "/proc/net/arp": head + text})
    assert route.route_to(C4G, tree.system()) is None
    assert route.neighbour(C4G, "eth1", tree.system()) is None


@given(text=st.text())
def test_nonsense_about_a_card_is_still_a_verdict(
    tmp_path_factory: pytest.TempPathFactory, text: str
) -> None:
    tree = Tree(tmp_path_factory.mktemp("nonsense"))
    tree.write(card(speed=text, duplex=text, operstate="up"))
    assert device_check("eth1", tree.system()).found


# --- port ------------------------------------------------------------------------------------


def test_a_privileged_port_gets_the_setting_that_frees_it_for_good(tree: Tree) -> None:
    tree.write({"/proc/sys/net/ipv4/ip_unprivileged_port_start": "1024\n"})
    trial = port.SocketTrial(errno.EACCES)
    check = port.port_check("0.0.0.0", 1000, trial, tree.system())
    assert check.status is Status.BAD
    assert "1024" in check.found
    assert "net.ipv4.ip_unprivileged_port_start=1000" in check.remedy[0]


def test_the_owner_of_a_port_is_named(tree: Tree) -> None:
    line = " 12: 00000000:03E8 00000000:0000 07 00000000:00000000 00:00000000 0 1000 0 4711 2 0 0\n"
    tree.write({"/proc/net/udp": "header\n" + line + "garbage\n", "/proc/42/comm": "orchestra\n"})
    folder = tree.root / "proc/42/fd"
    folder.mkdir()
    (folder / "3").symlink_to("/dev/null")
    (folder / "4").symlink_to("socket:[4711]")
    trial = port.SocketTrial(errno.EADDRINUSE)
    assert "orchestra (process 42)" in port.port_check("", 1000, trial, tree.system()).found
    assert "another user" in port.port_check("", 1001, trial, tree.system()).found


def test_a_port_in_use_here_is_found_in_use() -> None:
    assert port.try_port("127.0.0.1", 0).error == 0
    assert port.try_port("192.0.2.77", 0).error == errno.EADDRNOTAVAIL


def test_every_way_a_bind_can_fail_is_bad(tree: Tree) -> None:
    for number in (errno.EADDRNOTAVAIL, errno.EACCES, errno.EADDRINUSE, errno.ENOBUFS, -1):
        check = port.port_check("10.2.12.149", 1000, port.SocketTrial(number), tree.system())
        assert check.status is Status.BAD


def test_only_busy_polling_may_be_refused_without_a_warning() -> None:
    assert port.options_check(port.SocketTrial(0, ("SO_BUSY_POLL",), 212992)).status is Status.OK
    assert port.options_check(port.SocketTrial(0, ("SO_PRIORITY",), 1)).status is Status.WARN


# --- CAN -------------------------------------------------------------------------------------

FD = CanLink("socketcan", "can0", True, 1_000_000, 5_000_000)
BUS = {"/sys/class/net/can0/type": "280", "/sys/class/net/can0/operstate": "up"}


def ip_says(text: str) -> Answer:
    return Answer(0, text)


def rates(nominal: int, data: int | None) -> Answer:
    fast = f', "data_bittiming": {{"bitrate": {data}}}' if data else ""
    info = f'{{"bittiming": {{"bitrate": {nominal}}}{fast}}}'
    return ip_says(f'[{{"linkinfo": {{"info_kind": "can", "info_data": {info}}}}}]')


@pytest.mark.parametrize(
    ("answer", "status"),
    [
        (rates(1_000_000, 5_000_000), Status.OK),
        (rates(500_000, 5_000_000), Status.BAD),
        (rates(1_000_000, 2_000_000), Status.BAD),
        (rates(1_000_000, None), Status.BAD),
        (ip_says("[]"), Status.UNKNOWN),
        (ip_says("not json"), Status.UNKNOWN),
        (ip_says('[{"linkinfo": {"info_kind": "vcan"}}]'), Status.OK),
    ],
)
def test_the_bit_rates_have_to_be_the_cells(tree: Tree, answer: Answer, status: Status) -> None:
    assert can_check(FD, tree.write(BUS).system(ip=answer)).status is status


def test_a_bus_that_is_down_gets_the_command_that_brings_it_up(tree: Tree) -> None:
    tree.write(BUS | {"/sys/class/net/can0/operstate": "down"})
    check = can_check(FD, tree.system())
    assert check.status is Status.BAD
    assert "bitrate 1000000 dbitrate 5000000 fd on" in check.remedy[0]


def test_a_missing_or_foreign_interface_is_bad_and_an_adapter_is_not_touched(tree: Tree) -> None:
    assert can_check(FD, tree.system()).status is Status.BAD
    tree.write(BUS | {"/sys/class/net/can0/type": "1"})
    assert can_check(FD, tree.system()).status is Status.BAD
    serial = CanLink("slcan", "/dev/ttyACM0", False)
    assert can_check(serial, tree.system()).status is Status.UNKNOWN
