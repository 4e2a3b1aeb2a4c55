"""Pages, read as a browser does, and results to show on them."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from html.parser import HTMLParser
from typing import Any

import numpy as np

from hil.results.results import Results
from hil.results.series import ReportSeries
from sim_fixtures.ns16 import N_ESSENTIAL, TABLE2

JOINTS = [f"joint_{j}" for j in range(1, 7)]
TORQUE = np.array([496.0, 643.0, 158.0, 17.0, 23.0, 20.0])  # RMS of a fast motion, N·m
N = len(JOINTS)
FITTED = {
    "relative_error": [0.02] * N,
    "overall_relative_error": 0.021,
    "all_rows_relative_error": 0.043,
    "all_rows_joint_errors": [0.05] * N,
}
HOSTILE = '$\\frac$\x07"><script>alert(1)</script><img src=x onerror=alert(2)>--></svg>{{7*7}}'


# fmt: off
def make_results(**changes):
    """The NS 16 as a campaign on the simulated cell would leave it; `changes` replace fields."""
    rng = np.random.default_rng(16)
    truth = np.array([row.pi_c or 0.0 for row in TABLE2])
    size = len(TABLE2)
    std = (0.002 + 0.004 * np.abs(truth)) * rng.lognormal(0.0, 0.5, size)
    estimate = truth + std * rng.standard_normal(size)
    values = estimate + 5.0 * std * rng.standard_normal((30, size))
    inside = [int(np.sum(np.abs(estimate - truth) <= k * std)) for k in (2, 3)]
    fields: dict[str, Any] = {
        "name": "demo", "cell": "COMAU SMART NS 16-1.65", "simulated": True,
        "effects": ["gear ripple 0.5 %", "friction drift 3 % in 20 min", "delay 0.3 ms"],
        "joint_names": JOINTS, "period": 0.002,
        "software": {"hil": "0.1.0", "numpy": "2.4.6", "pinocchio": "4.1.0"},
        "excitation": {"duration": 14.85, "n_via": 6, "fly": 0.5, "coupling_index_max": 1653.0,
                       "planned": _criteria(88.12, 118.4), "executed": _criteria(87.63, 119.2)},
        "estimator": {"name": "wls", "words": "weighted least squares (eq. 4)",
                      "prior": "nominal parameters to 10 %", "condition": 26.4,
                      "grouping": "40 of 66 standard parameters are independent."},
        "notes": ["position noise was measured at standstill"],
        "parameters": [
            {"name": row.pivot or row.parameter, "expression": row.parameter,
             "unit": _unit(row.pivot or row.parameter), "table2_id": row.id, "truth": truth[i],
             "estimate": estimate[i], "std": std[i], "repetition_mean": values[:, i].mean(),
             "repetition_std": values[:, i].std(ddof=1), "prior_std": 10.0 * std[i],
             "prior_ratio": 0.1, "learned": True}
            for i, row in enumerate(TABLE2)
        ],
        "n_base": N_ESSENTIAL,
        "uncertainty": {
            "method": "weighted least squares", "interval_factor": 2.05,
        },
        "repetitions": [f"excitation_{k:03d}_a1.mcap" for k in range(1, 31)],
        "repetition_values": values, "noise_std": 0.012 * TORQUE,
        "correlation": _correlation(rng, size),
        "validation": [_validation(rng, k) for k in range(1, 13)],
        "fitted": FITTED, "choices": [], "judgement": _judgement(),
        "coverage": {"within_2": inside[0], "within_3": inside[1], "total": size},
        "verdict": {
            "good": True, "line": "The model predicts unseen motion to 1.5 % of the torque.",
            "reasons": ["Held-out error is 1.3 times the residual of the fit (allowed: 2).",
                        "52 of 58 parameters lie within two standard deviations of the truth."],
            "warnings": ["f2_1 is not distinct from zero."],
        },
    }
    text = json.dumps(fields | changes, default=lambda a: np.asarray(a).tolist())
    return Results.model_validate_json(text)


def _unit(name):
    units = {"m": "kg·m", "I": "kg·m²", "f0": "N·m", "f1": "N·m·s/rad", "f2": "N·m·s²/rad²"}
    return next(unit for start, unit in units.items() if name.startswith(start))


def _correlation(rng, size):
    """Neighbours in the chain share what a motion shows of them."""
    shared = rng.uniform(0.0, 1.0, (size, 1)) * rng.standard_normal((15, 90))[np.arange(size) // 4]
    return np.corrcoef(rng.standard_normal((size, 90)) + 3.0 * shared)


def _criteria(log10_det, coupling):
    return {"log10_det": log10_det, "coupling_index": coupling,
            "fitness": 0.7 * log10_det + 0.3 * 1653.0 / coupling, "n_samples": 7425,
            "condition": 48210.0, "scaled_condition": 96.4}


def _judgement():
    profile = {"centre": [-1.0, 0.0, 1.0], "mean": [0.5, None, -0.5], "std": [0.1, None, 0.1]}
    joint = {"unit": "N·m", "rms": 2.0, "relative": 0.02, "explained": 0.99, "limit": None,
             "share_of_limit": None, "nominal_relative": 0.3, "controller_relative": None}
    findings = [{"check": "delay", "level": "good", "words": "no other delay"},
                {"check": "whiteness", "level": "doubtful", "words": "not white", "next_step": "x"}]
    return {"findings": findings, "next_steps": ["x"],
            "joints": [joint | {"joint": name} for name in JOINTS],
            "speed": [profile] * N, "position": [profile] * N}


def _validation(rng, k):
    rms = 0.016 * TORQUE * rng.lognormal(0.0, 0.2, 6)
    return {"archive": f"validation_{k:03d}_a1.mcap", "duration": 8.0 + k / 3.0,
            "mean_abs_error": 0.78 * rms, "rms_error": rms,
            "mean_error": 0.1 * rms * rng.standard_normal(6), "relative_error": rms / TORQUE,
            "all_rows_joint_errors": [0.06] * N,
            "all_rows_relative_error": 0.05,
            "overall_relative_error": float(np.linalg.norm(rms) / np.linalg.norm(TORQUE))}


def make_series(samples = 2000, joints = 6, name = "v.mcap"):
    """Smooth motion with the amplitudes of a real one, and a torque that is nearly right."""
    rng = np.random.default_rng(4)
    time = 0.002 * np.arange(samples)
    half = samples // 2
    rate = rng.uniform(0.4, 2.6, (4, joints))
    phase = rng.uniform(0.0, 6.28, (4, joints))
    angle = rate * time[:, None, None] + phase
    position = 0.7 * np.sin(angle).sum(axis=1)
    velocity = 0.7 * (rate * np.cos(angle)).sum(axis=1)
    size = np.resize(TORQUE, joints)
    torque = size * (np.sin(position) + 0.3 * np.tanh(40.0 * velocity))
    noise = np.convolve(rng.standard_normal(samples), np.ones(9) / 3.0, "same")[:, None]
    fitted = np.ones((samples, joints))
    used = np.ones((half, joints))
    fitted[: samples // 4] = used[-samples // 20:] = 0.0
    parts = (0.3 * size * np.sin(position) * noise, 0.1 * size * np.cos(position))
    frequency = np.linspace(0.25, 250.0, 60)
    density = size / (1.0 + frequency[:, None] ** 2)
    speed = rng.uniform(-1.0, 1.0, (300, joints))
    law_speed = np.repeat(np.linspace(-1.0, 1.0, 40)[:, None], joints, axis=1)
    return ReportSeries(
        excitation_time=time, excitation_position=position, excitation_velocity=velocity,
        excitation_fitted=fitted, example_archive=name, example_time=time[:half],
        example_measured=(torque + 0.012 * size * noise)[:half], example_predicted=torque[:half],
        example_used=used, friction_speed=speed,
        friction_torque=0.1 * size * (np.sign(speed) + speed), law_speed=law_speed,
        law_torque=0.1 * size * (np.sign(law_speed) + law_speed),
        example_nominal=0.7 * torque[:half], example_inertia=parts[0][:half],
        example_coriolis=parts[1][:half], example_gravity=size * np.sin(position[:half]),
        example_friction=0.3 * size * np.tanh(40.0 * velocity[:half]),
        spectrum_frequency=frequency, spectrum_measured=density,
        spectrum_residual=0.02 * density + 1e-3,
    )


class Page(HTMLParser):
    """What a browser would make of a page, as far as these tests care."""

    def __init__(self, text):
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.tables: list[list[list[str]]] = []
        self.words: list[str] = []
        self._in_cell = False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in {"td", "th"}:
            self.tables[-1][-1].append("")
            self._in_cell = True

    def handle_endtag(self, tag):
        self._in_cell = self._in_cell and tag not in {"td", "th"}

    def handle_data(self, data):
        if not self.tags or self.tags[-1][0] not in {"style", "script"}:
            self.words.append(data)
        if self._in_cell:
            self.tables[-1][-1][-1] += data

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())

    def table(self, heading):
        """Rows of the table that has a column `heading`, by column heading."""
        rows = next(rows for rows in self.tables if heading in rows[0])
        return [dict(zip(rows[0], row, strict=True)) for row in rows[1:] if len(row) > 1]


def assert_stands_alone(html):
    """The law of every page: nothing from outside, ids and references that fit.

    Its scripts are those that the policy of the page names by their digests, the last is our own.
    """
    page = Page(html)
    assert not {"link", "iframe", "object", "embed"} & {tag for tag, _ in page.tags}
    attributes = [a for tag, a in page.tags if tag == "script"]
    assert all(a in ({}, {"type": "application/json", "id": "chart-data"}) for a in attributes)
    links = [a[key] for _, a in page.tags for key in a if key in {"src", "href", "xlink:href"}]
    assert all((link or "").startswith(("#", "data:image/png;base64,")) for link in links)
    scripts = re.findall(r"<script>(.*?)</script>", html, re.S)
    ours = [script for script in scripts if "Bokeh Contributors" not in script]
    for library in set(scripts) - set(ours):
        html = html.replace(library, "")
    assert "@import" not in html
    assert all(target.startswith("#") for target in re.findall(r"url\(([^)]*)\)", html))
    policy = next(a["content"] or "" for t, a in page.tags if t == "meta" and "http-equiv" in a)
    digests = [base64.b64encode(hashlib.sha256(s.encode()).digest()).decode() for s in scripts]
    allowed = " ".join(f"'sha256-{digest}'" for digest in digests)
    assert policy.startswith("default-src 'none'") and f"script-src {allowed};" in policy
    assert "unsafe" not in policy.split("script-src")[1].split(";")[0]
    calls = r"eval\(|innerHTML|insertAdjacentHTML|https?:(?!//www\.w3\.org/2000/svg)"
    assert ours and not any(re.findall(calls, script) for script in ours)
    ids = [a["id"] for _, a in page.tags if "id" in a]
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'(?:href="|url\()#([^")]*)', html)) <= set(ids)


def assert_inert(page, *, charts=True):
    """Names from archives start nothing: there are our script and, for charts, data and library."""
    scripts = [a.get("type") for tag, a in page.tags if tag in {"script", "img"}]
    assert scripts == (["application/json", None, None, None, None] if charts else [None])
    assert not [name for _, a in page.tags for name in a if name.startswith("on")]


def with_joints(results, n):
    """The same results of an arm of n joints."""

    def widened(value):
        six = isinstance(value, list) and len(value) == N
        return [value[k % N] for k in range(n)] if six else value

    def section(part):
        return {key: widened(value) for key, value in part.items()}

    whole = section(results.model_dump())
    whole["fitted"] = section(whole["fitted"])
    whole["judgement"] = section(whole["judgement"])
    whole["validation"] = [section(run) for run in whole["validation"]]
    return Results.model_validate(whole)
