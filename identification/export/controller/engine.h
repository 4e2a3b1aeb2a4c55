#ifndef ARM_H
#define ARM_H

#ifdef __cplusplus
extern "C" {
#endif

/* Arrays have one entry for each joint, in the order above, in rad, rad/s, rad/s2, N m
   (m, m/s, m/s2, N for prismatic joints). No function allocates, blocks or fails. */

/* Gravity in the axes of the base [m/s2], and the payload: mass [kg], centre of mass [m] and inertia
   about it, xx xy xz yy yz zz [kg m2], in the payload frame above. Both start as identified. Set them
   before the control loop starts, or between two cycles of it: the other functions read them. */
void arm_set_gravity(const arm_real gravity[3]);
void arm_set_payload(arm_real mass, const arm_real centre[3], const arm_real inertia[6]);

/* Torque of bodies, payload, rotors and springs, without friction. */
void arm_rigid_torque(const arm_real q[], const arm_real v[], const arm_real a[], arm_real tau[]);

/* The same at rest: what holds the arm against gravity and springs. */
void arm_gravity(const arm_real q[], arm_real tau[]);

/* Inertia seen by the joints, row by row: ARM_JOINTS * ARM_JOINTS entries. */
void arm_mass_matrix(const arm_real q[], arm_real mass[]);

/* Dry friction at reversals: its displacement in the gear teeth (presliding). One for each place that
   follows a motion, started where the motion starts. dt is the time between two cycles [s]. */
typedef struct {
    arm_real dt;
    arm_real position[ARM_AXES], velocity[ARM_AXES], direction[ARM_AXES];
} arm_presliding;
void arm_presliding_start(arm_presliding *state, arm_real dt, const arm_real q[], const arm_real v[]);

/* Identified friction and offsets. Call it once a cycle with a started state; without a state (0) dry
   friction has the sign of the speed. */
void arm_friction(const arm_real q[], const arm_real v[], const arm_real a[], arm_presliding *state,
                  arm_real tau[]);

/* The whole torque, dry friction with the sign of the speed: feed-forward of a planned motion. */
void arm_torque(const arm_real q[], const arm_real v[], const arm_real a[], arm_real tau[]);

/* Torque from outside, by the momentum of the arm (De Luca and Mattone 2003): a low-pass with the
   gain [1/s], 1 / gain being its time constant. tau is the measured or commanded torque. */
typedef struct {
    arm_real gain;
    arm_real integral[ARM_JOINTS], external[ARM_JOINTS];
    arm_presliding presliding;
} arm_observer;
void arm_observer_start(arm_observer *observer, arm_real gain, arm_real dt, const arm_real q[],
                        const arm_real v[]);
void arm_observer_step(arm_observer *observer, const arm_real q[], const arm_real v[],
                       const arm_real tau[], arm_real external[]);

#if ARM_THRESHOLDS > 0
/* Torque from outside that motion without contact exceeded once in a period [s], from motion that was
   not fitted and for an observer below 10 Hz, with its 95 % interval. The first period is what that
   motion shows; longer ones are extrapolated (peaks over threshold, exponential tail). */
extern const arm_real arm_threshold_period[ARM_THRESHOLDS];
extern const arm_real arm_threshold[ARM_THRESHOLDS][ARM_JOINTS];
extern const arm_real arm_threshold_low[ARM_THRESHOLDS][ARM_JOINTS];
extern const arm_real arm_threshold_high[ARM_THRESHOLDS][ARM_JOINTS];
/* In the middle of the joints' ranges: force at the flange [N] that 95 % of directions show above them,
   and the mass there [kg] whose weight does. */
extern const arm_real arm_threshold_force[ARM_THRESHOLDS];
extern const arm_real arm_threshold_mass[ARM_THRESHOLDS];
#endif

#ifdef __cplusplus
}
#endif

#endif
