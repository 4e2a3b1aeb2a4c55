from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from identification import FrictionLaw, Preprocessing, Recording, RobotModel, prepare
from identification.factor.factor import Factor, estimate
from identification.model.base_parameters import TOLERANCE
from identification.model.coupling import Coupling
from identification.validation.prediction import prediction_error
from sim_fixtures.ns16 import N_ESSENTIAL, TABLE2, urdf_text
from tests.identification.robots import NS16_TURNS, robot_text


@pytest.fixture(scope="module")
def model():
    return RobotModel.from_urdf(urdf_text())


ARMS = {
    "ur5": "ur_description/urdf/ur5_robot.urdf",
    "ur3 with a gripper": "ur_description/urdf/ur3_gripper.urdf",
    "panda, fingers sliding": "panda_description/urdf/panda.urdf",
    "kinova, continuous": "kinova_description/robots/kinova.urdf",
    "xarm7": "xarm_description/urdf/xarm7.urdf",
    "so100, joint named as its link": "so_arm_description/urdf/so100.urdf",
    "tiago, sliding torso": "tiago_description/robots/tiago_no_hand.urdf",
    "allegro hand, four branches": "allegro_hand_description/urdf/allegro_left_hand.urdf",
    "talos arm, mimicking": "talos_data/robots/talos_left_arm.urdf",
}


# Angles rounded in the file (1.5708) make singular values of up to 4e-5, real parameters of 1e-3.
ROUNDED = 1e-4


def rank_by_pinocchio(urdf):
    """Numerical rank of pinocchio's own regressor with a column per rotor."""
    model = pin.buildModelFromXML(urdf)
    data = model.createData()
    random = np.random.default_rng(11)
    rows = []
    for _ in range(20 + 2 * model.nv):
        q = pin.integrate(model, pin.neutral(model), random.uniform(-3.0, 3.0, model.nv))
        qd, qdd = random.uniform(-3.0, 3.0, (2, model.nv))
        links = pin.computeJointTorqueRegressor(model, data, q, qd, qdd)
        rows.append(np.hstack([links, np.diag(qdd)]))
    stacked = np.vstack(rows)
    length = np.linalg.norm(stacked, axis=0)
    felt = length > ROUNDED * length.max()
    singular = np.linalg.svd(stacked[:, felt] / length[felt], compute_uv=False)
    return int(np.count_nonzero(singular > ROUNDED * singular[0]))


class TestBaseParameters:
    @pytest.mark.parametrize("coupling", [None, Coupling(NS16_TURNS)])
    def test_the_groups_of_the_ns16_are_those_of_table_2(self, coupling):
        """Coupled motors add three inertias by themselves."""
        model = RobotModel.from_urdf(urdf_text(), coupling=coupling)
        rows = {row.pivot: row for row in TABLE2[:N_ESSENTIAL]}
        own = {"I45", "I46", "I56"} if coupling else set()
        assert set(model.base.names) == set(rows) | own
        assert model.base.largest_dropped < 1e-10 * model.base.smallest_pivot
        for name, group in zip(model.base.names, model.base.grouping, strict=True):
            # Rows 29 and 31 are printed for minus the pivot.
            terms, sign = ({name: 1.0}, 1) if name in own else (rows[name].terms, rows[name].sign)
            expected = np.zeros(len(model.layout.names))
            for standard, factor in terms.items():
                expected[model.layout.names.index(standard)] = sign * factor
            assert np.abs(group - expected).max() < 1e-10, name

    @pytest.mark.parametrize(
        ("gravity", "rotors", "rank"),
        [
            ((0.0, 0.0, -9.81), True, 40),
            ((0.0, 0.0, 9.81), True, 40),
            ((0.0, 0.0, -9.81), False, 36),
            ((3.0, 0.0, -9.0), True, 42),
        ],
    )
    def test_the_rank_of_the_ns16(self, gravity, rotors, rank):
        base = RobotModel.from_urdf(urdf_text(), gravity=gravity, rotor_inertia=rotors).base
        assert base.rank == len(base.names) == rank
        assert base.largest_dropped < 1e-10 * base.smallest_pivot
        assert base.smallest_pivot > 1000 * TOLERANCE
        if gravity == (0.0, 0.0, 9.81):  # upside down it groups alike
            upright = RobotModel.from_urdf(urdf_text()).base
            assert np.allclose(base.grouping, upright.grouping, atol=1e-10)

    def test_angles_rounded_in_the_file_do_not_split_groups(self, model):
        text = urdf_text()
        assert "1.5707963267948966" in text
        rounded = RobotModel.from_urdf(text.replace("1.5707963267948966", "1.5708")).base
        assert rounded.names == model.base.names
        assert 1e-8 < rounded.largest_dropped < 1e-5 < rounded.smallest_pivot
        # Their traces are not printed as groups either.
        assert np.array_equal(rounded.grouping != 0.0, model.base.grouping != 0.0)

    def test_groups_are_named_by_their_first_parameter(self, model):
        base, again = model.base, RobotModel.from_urdf(urdf_text()).base
        assert again.names == base.names
        assert np.array_equal(again.grouping, base.grouping)
        assert np.array_equal(base.grouping[:, base.pivots], np.eye(base.rank))
        assert tuple(base.standard_names[k] for k in base.pivots) == base.names
        assert np.all(np.diff(base.pivots) > 0)
        # A parameter is dropped since those before it explain it.
        for column in set(range(len(base.standard_names))) - set(base.pivots.tolist()):
            groups = base.pivots[np.flatnonzero(base.grouping[:, column])]
            assert np.all(groups < column), base.standard_names[column]

    def test_an_unclear_rank_is_reported(self, model):
        """The first axis a ten-thousandth of a radian off gravity: more is felt, but hardly."""
        skewed = urdf_text().replace("1.5707963267948966", "1.5709")
        base = RobotModel.from_urdf(skewed).base
        assert base.rank > model.base.rank
        assert base.smallest_pivot < 1e-4
        weakest = base.names[int(np.argmin(base.shares[base.pivots]))]
        assert f"{base.smallest_pivot:.1e} ({weakest})" in base.explanation()

    @pytest.mark.parametrize("arm", ARMS)
    def test_the_rank_is_that_of_pinocchios_regressor(self, arm):
        urdf = robot_text(ARMS[arm])
        base = RobotModel.from_urdf(urdf).base
        assert base.rank == rank_by_pinocchio(urdf)
        assert base.largest_dropped < 1e-4 * base.smallest_pivot


DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "tx40"
GEARS = np.array([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
# Joint 5 turns motor 6 along (Gautier; the same in the published identification of this arm).
TURNS = np.diag(GEARS)
TURNS[5, 4] = GEARS[5]
HOME = np.array([0.0, -np.pi / 2, np.pi / 2, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def recording():
    if not DATA.is_dir():
        pytest.skip(f"there are no recordings at {DATA}")
    motor, torque = (
        np.loadtxt(DATA / name, delimiter=",", skiprows=1)
        for name in ("pos_read_data.csv", "curr_data.csv")
    )
    return Recording(
        time=np.arange(len(motor)) * 2e-4,
        position=motor @ np.linalg.inv(TURNS).T + HOME,
        joint_names=tuple(f"joint_{j}" for j in range(1, 7)),
        torque=torque @ TURNS,
    )


def fitted(recording, coupling):
    model = RobotModel.from_urdf(
        (DATA / "tx40_mdh_modified.urdf").read_text(encoding="utf-8"),
        friction=FrictionLaw(offset=True),
        coupling=coupling,
    )
    options = Preprocessing(smooth_torque=True, torque_bandwidth=40.0)
    samples = prepare(recording, model, options=options)
    found = estimate(model, Factor.of(model, samples), np.ones(6))
    (error,) = prediction_error(model, found.values, [samples], all_rows=True)
    return found, error


class TestPublishedRecording:
    def test_the_coupling_explains_it(self, recording):
        """Comparators, with linear friction: 10.9 % with, 14.3 % without; joint 5: 19 %, 53 %."""
        _, without = fitted(recording, None)
        _, coupled = fitted(recording, Coupling(TURNS))
        assert coupled.overall <= 0.109
        assert coupled.relative[4] <= 0.19
        assert without.overall > 0.12
        assert without.relative[4] > 0.45

    def test_the_coupled_motors_parameters_are_the_published_ones(self, recording):
        """Iam6, fsm6 and fvm6 of the YAML beside the data: 0.00964, 1.95, 0.616."""
        found, _ = fitted(recording, Coupling(TURNS))
        values = dict(zip(found.names, found.values, strict=True))
        assert values["I56"] == pytest.approx(0.00964, rel=0.05)
        assert values["f0_m6"] == pytest.approx(1.95, rel=0.05)
        assert values["f1_m6"] == pytest.approx(0.616, rel=0.05)
