/* ---- what follows is the same for every arm ---- */

static arm_real gravity[3] = ARM_GRAVITY;
static arm_real carried[10] = ARM_PAYLOAD; /* of the payload, in the frame of PAYLOAD_JOINT */

void arm_set_gravity(const arm_real g[3])
{
    for (int k = 0; k < 3; k++) gravity[k] = g[k];
}

static void cross(const arm_real a[], const arm_real b[], arm_real out[])
{
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

static void add_cross(const arm_real a[], const arm_real b[], arm_real sum[])
{
    sum[0] += a[1] * b[2] - a[2] * b[1];
    sum[1] += a[2] * b[0] - a[0] * b[2];
    sum[2] += a[0] * b[1] - a[1] * b[0];
}

static arm_real dot(const arm_real a[], const arm_real b[])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* out = r b, from a joint's axes to its parent's */
static void rotate(const arm_real r[], const arm_real b[], arm_real out[])
{
    for (int k = 0; k < 3; k++) out[k] = r[3 * k] * b[0] + r[3 * k + 1] * b[1] + r[3 * k + 2] * b[2];
}

/* out = r' b, from the parent's axes to the joint's */
static void rotate_back(const arm_real r[], const arm_real b[], arm_real out[])
{
    for (int k = 0; k < 3; k++) out[k] = r[k] * b[0] + r[k + 3] * b[1] + r[k + 6] * b[2];
}

/* out = tensor b, of xx xy xz yy yz zz */
static void times_tensor(const arm_real t[], const arm_real b[], arm_real out[])
{
    out[0] = t[0] * b[0] + t[1] * b[1] + t[2] * b[2];
    out[1] = t[1] * b[0] + t[3] * b[1] + t[4] * b[2];
    out[2] = t[2] * b[0] + t[4] * b[1] + t[5] * b[2];
}

void arm_set_payload(arm_real mass, const arm_real centre[3], const arm_real inertia[6])
{
    arm_real c[3], row[3], tensor[9];
    rotate(payload_rotation, centre, c);
    for (int k = 0; k < 3; k++) c[k] += payload_origin[k];
    for (int i = 0; i < 3; i++) { /* R I R', column by column of R' */
        times_tensor(inertia, &payload_rotation[3 * i], row);
        for (int k = 0; k < 3; k++) tensor[3 * i + k] = dot(&payload_rotation[3 * k], row);
    }
    const arm_real square = dot(c, c);
    for (int i = 0, k = 0; i < 3; i++)
        for (int j = i; j < 3; j++, k++)
            carried[k] = tensor[3 * i + j] - mass * c[i] * c[j] + (i == j ? mass * square : 0);
    for (int k = 0; k < 3; k++) carried[6 + k] = mass * c[k];
    carried[9] = mass;
}

/* The bodies of the arm: tensor about the joint's origin, first moments, mass. */
static const arm_real *body_of(int i, arm_real sum[10])
{
    if (i != PAYLOAD_JOINT) return &body[10 * i];
    for (int k = 0; k < 10; k++) sum[k] = body[10 * i + k] + carried[k];
    return sum;
}

/* Axes and origin of a joint in its parent's frame. */
static void place(int i, arm_real q, arm_real r[9], arm_real p[3])
{
    const arm_real c = revolute[i] ? ARM_COS(q) : 1;
    const arm_real s = revolute[i] ? ARM_SIN(q) : 0;
    for (int k = 0; k < 9; k++)
        r[k] = turn_fixed[9 * i + k] + c * turn_cos[9 * i + k] + s * turn_sin[9 * i + k];
    for (int k = 0; k < 3; k++) p[k] = origin[3 * i + k] + q * slide[3 * i + k];
}

/* Recursive Newton-Euler (Luh, Walker and Paul 1980) of bodies and payload; v and a may be 0. */
static void newton_euler(const arm_real q[], const arm_real v[], const arm_real a[],
                         const arm_real g[3], arm_real tau[])
{
    arm_real r[ARM_JOINTS][9], p[ARM_JOINTS][3], f[ARM_JOINTS][3], n[ARM_JOINTS][3];
    arm_real w[ARM_JOINTS + 1][3], dw[ARM_JOINTS + 1][3], acc[ARM_JOINTS + 1][3]; /* 0: base */
    for (int k = 0; k < 3; k++) {
        w[0][k] = dw[0][k] = 0;
        acc[0][k] = -g[k];
    }
    for (int i = 0; i < ARM_JOINTS; i++) {
        const int up = parent[i] + 1;
        const arm_real *z = &axis[3 * i];
        const arm_real vi = v ? v[i] : 0, ai = a ? a[i] : 0;
        arm_real sum[10], t[3], u[3], iw[3];
        place(i, q[i], r[i], p[i]);
        cross(w[up], p[i], t);
        for (int k = 0; k < 3; k++) u[k] = acc[up][k];
        add_cross(dw[up], p[i], u);
        add_cross(w[up], t, u);
        arm_real *wi = w[i + 1], *dwi = dw[i + 1], *ai3 = acc[i + 1];
        rotate_back(r[i], w[up], wi);
        rotate_back(r[i], dw[up], dwi);
        rotate_back(r[i], u, ai3);
        cross(wi, z, t);
        if (revolute[i])
            for (int k = 0; k < 3; k++) {
                dwi[k] += z[k] * ai + t[k] * vi;
                wi[k] += z[k] * vi;
            }
        else
            for (int k = 0; k < 3; k++) ai3[k] += z[k] * ai + 2 * t[k] * vi;
        const arm_real *b = body_of(i, sum), *moment = &b[6];
        cross(wi, moment, t);
        for (int k = 0; k < 3; k++) f[i][k] = b[9] * ai3[k];
        add_cross(dwi, moment, f[i]);
        add_cross(wi, t, f[i]);
        times_tensor(b, dwi, n[i]);
        times_tensor(b, wi, iw);
        add_cross(wi, iw, n[i]);
        add_cross(moment, ai3, n[i]);
    }
    for (int i = ARM_JOINTS - 1; i >= 0; i--) {
        const int up = parent[i];
        tau[i] = dot(&axis[3 * i], revolute[i] ? n[i] : f[i]);
        if (up < 0) continue;
        arm_real fp[3], np[3];
        rotate(r[i], f[i], fp);
        rotate(r[i], n[i], np);
        add_cross(p[i], fp, np);
        for (int k = 0; k < 3; k++) {
            f[up][k] += fp[k];
            n[up][k] += np[k];
        }
    }
}

/* Momentum of the joints without rotors, and C' v: the derivative of the kinetic energy by q. */
static void momentum(const arm_real q[], const arm_real v[], arm_real joint[], arm_real bias[])
{
    arm_real r[ARM_JOINTS][9], p[ARM_JOINTS][3], w[ARM_JOINTS + 1][3], u[ARM_JOINTS + 1][3];
    arm_real linear[ARM_JOINTS][3], angular[ARM_JOINTS][3];
    for (int k = 0; k < 3; k++) w[0][k] = u[0][k] = 0;
    for (int i = 0; i < ARM_JOINTS; i++) {
        const int up = parent[i] + 1;
        arm_real sum[10], t[3];
        place(i, q[i], r[i], p[i]);
        for (int k = 0; k < 3; k++) t[k] = u[up][k];
        add_cross(w[up], p[i], t);
        rotate_back(r[i], w[up], w[i + 1]);
        rotate_back(r[i], t, u[i + 1]);
        for (int k = 0; k < 3; k++) *(revolute[i] ? &w[i + 1][k] : &u[i + 1][k]) += axis[3 * i + k] * v[i];
        const arm_real *b = body_of(i, sum);
        for (int k = 0; k < 3; k++) linear[i][k] = b[9] * u[i + 1][k];
        add_cross(w[i + 1], &b[6], linear[i]);
        times_tensor(b, w[i + 1], angular[i]);
        add_cross(&b[6], u[i + 1], angular[i]);
    }
    for (int i = ARM_JOINTS - 1; i >= 0; i--) {
        const int up = parent[i];
        const arm_real *z = &axis[3 * i];
        arm_real t[3];
        cross(w[i + 1], z, t);
        if (revolute[i]) {
            joint[i] = dot(z, angular[i]);
            bias[i] = dot(angular[i], t);
            cross(u[i + 1], z, t);
            bias[i] += dot(linear[i], t);
        } else {
            joint[i] = dot(z, linear[i]);
            bias[i] = dot(linear[i], t);
        }
        if (up < 0) continue;
        arm_real lp[3], ap[3];
        rotate(r[i], linear[i], lp);
        rotate(r[i], angular[i], ap);
        add_cross(p[i], lp, ap);
        for (int k = 0; k < 3; k++) {
            linear[up][k] += lp[k];
            angular[up][k] += ap[k];
        }
    }
}

static void add_product(const arm_real matrix[], const arm_real x[], arm_real sum[])
{
    for (int i = 0; i < ARM_JOINTS; i++)
        for (int j = 0; j < ARM_JOINTS; j++) sum[i] += matrix[ARM_JOINTS * i + j] * x[j];
}

/* Springs, balancers and torque ripple; ripple does not load the gears. */
static void add_elements(const arm_real q[], int ripple, arm_real tau[])
{
#if ARM_ELEMENTS > 0
    for (int e = 0; e < ARM_ELEMENTS; e++) {
        const arm_real *c = &element_value[8 * e];
        arm_real angle = 0, torque = 0;
        for (int j = 0; j < ARM_JOINTS; j++) angle += element_turns[ARM_JOINTS * e + j] * q[j];
        if (element_kind[e] == TORSION_SPRING) {
            torque = c[0] * (angle - c[1]);
        } else if (element_kind[e] == TORQUE_RIPPLE) {
            if (ripple) torque = c[0] * ARM_COS(c[2] * angle) + c[1] * ARM_SIN(c[2] * angle);
        } else { /* between two anchors */
            const arm_real product = c[0] * c[1];
            const arm_real length =
                ARM_SQRT(c[0] * c[0] + c[1] * c[1] - 2 * product * ARM_COS(angle + c[2]));
            const arm_real lever = product * ARM_SIN(angle + c[2]) / length;
            if (element_kind[e] == EXTENSION_SPRING)
                torque = lever * (c[4] * (length - c[3]) + c[5]);
            else /* gas cylinder */
                torque = c[7] * lever * c[4] / (c[5] - c[6] * (length - c[3]));
        }
        tau[element_joint[e]] += torque;
    }
#else
    (void)q, (void)ripple, (void)tau;
#endif
}

void arm_rigid_torque(const arm_real q[], const arm_real v[], const arm_real a[], arm_real tau[])
{
    newton_euler(q, v, a, gravity, tau);
    add_product(rotor, a, tau);
    add_elements(q, 1, tau);
}

void arm_gravity(const arm_real q[], arm_real tau[])
{
    newton_euler(q, 0, 0, gravity, tau);
    add_elements(q, 1, tau);
}

void arm_mass_matrix(const arm_real q[], arm_real mass[])
{
    static const arm_real weightless[3] = {0, 0, 0};
    for (int j = 0; j < ARM_JOINTS; j++) { /* symmetric: row j is column j */
        arm_real unit[ARM_JOINTS] = {0};
        unit[j] = 1;
        newton_euler(q, 0, unit, weightless, &mass[ARM_JOINTS * j]);
        add_product(rotor, unit, &mass[ARM_JOINTS * j]);
    }
}

/* Position or speed of each joint, then of each coupled motor on its joint's side. */
static void of_axes(const arm_real joints[], arm_real axes[])
{
    for (int j = 0; j < ARM_JOINTS; j++) axes[j] = joints[j];
#if ARM_AXES > ARM_JOINTS
    for (int m = 0; m < ARM_AXES - ARM_JOINTS; m++) {
        axes[ARM_JOINTS + m] = 0;
        for (int j = 0; j < ARM_JOINTS; j++)
            axes[ARM_JOINTS + m] += motor_turns[ARM_JOINTS * m + j] * joints[j];
    }
#endif
}

static arm_real sign(arm_real x)
{
    return (arm_real)((x > 0) - (x < 0));
}

/* Direction of dry friction without a state. */
static arm_real direction_of(int k, arm_real v)
{
    if (linear_zone[k] <= 0) return sign(v);
    return v > linear_zone[k] ? 1 : v < -linear_zone[k] ? -1 : v / linear_zone[k];
}

/* Dahl's state (1968) after a displacement. */
static arm_real dahl(int k, arm_real state, arm_real displacement)
{
    const arm_real s = sign(displacement);
    if (s == 0) return state;
    return s + (state - s) * ARM_EXP(-s * displacement / presliding[k]);
}

void arm_presliding_start(arm_presliding *state, arm_real dt, const arm_real q[], const arm_real v[])
{
    state->dt = dt;
    of_axes(q, state->position);
    of_axes(v, state->velocity);
    for (int k = 0; k < ARM_AXES; k++) {
        const arm_real speed = state->velocity[k];
        state->direction[k] =
            presliding[k] > 0 ? dahl(k, 0, speed * dt) : direction_of(k, speed);
    }
}

static void slide_on(arm_presliding *state, const arm_real q[], const arm_real v[])
{
    arm_real position[ARM_AXES], velocity[ARM_AXES];
    of_axes(q, position);
    of_axes(v, velocity);
    for (int k = 0; k < ARM_AXES; k++) {
        if (presliding[k] > 0) {
            const arm_real before = state->velocity[k], from = state->position[k];
            arm_real turned = from;
            if (before * velocity[k] < 0) { /* where the interpolated speed is zero */
                turned += before * state->dt * before / (before - velocity[k]) / 2;
                state->direction[k] = dahl(k, state->direction[k], turned - from);
            }
            state->direction[k] = dahl(k, state->direction[k], position[k] - turned);
        } else {
            state->direction[k] = direction_of(k, velocity[k]);
        }
        state->position[k] = position[k];
        state->velocity[k] = velocity[k];
    }
}

/* Friction of one joint or motor: c has the coefficients in the order of FRICTION_*. */
static arm_real friction_of(const arm_real c[], arm_real v, arm_real direction, arm_real load)
{
    const arm_real size = ARM_ABS(v);
    arm_real dry = c[FRICTION_COULOMB] + c[FRICTION_LOAD] * ARM_ABS(load);
    if (c[FRICTION_STRIBECK] != 0) {
        const arm_real ratio = v / c[STRIBECK_SPEED];
        dry += c[FRICTION_STRIBECK] * ARM_EXP(-ratio * ratio);
    }
    arm_real torque = dry * direction + c[FRICTION_OFFSET] + c[FRICTION_ASYMMETRIC] * size +
                      v * (c[FRICTION_VISCOUS] + c[FRICTION_QUADRATIC] * size +
                           c[FRICTION_CUBIC] * v * v);
    if (c[FRICTION_TANH] != 0) torque += c[FRICTION_TANH] * ARM_TANH(v / c[TANH_SPEED]);
    return torque;
}

static void add_friction(const arm_real q[], const arm_real v[], const arm_real a[],
                         const arm_real direction[], arm_real tau[])
{
    arm_real speed[ARM_AXES], load[ARM_JOINTS] = {0};
    of_axes(v, speed);
#if FRICTION_HAS_LOAD
    newton_euler(q, v, a, gravity, load);
    if (a) add_product(load_rotor, a, load);
    add_elements(q, 0, load);
#else
    (void)q, (void)a;
#endif
    for (int j = 0; j < ARM_JOINTS; j++)
        tau[j] += friction_of(&friction[FRICTION_SIZE * j], speed[j], direction[j], load[j]);
#if ARM_AXES > ARM_JOINTS
    for (int m = 0; m < ARM_AXES - ARM_JOINTS; m++) {
        const int k = ARM_JOINTS + m;
        const arm_real torque = friction_of(&friction[FRICTION_SIZE * k], speed[k], direction[k], 0);
        for (int j = 0; j < ARM_JOINTS; j++) tau[j] += motor_turns[ARM_JOINTS * m + j] * torque;
    }
#endif
}

void arm_friction(const arm_real q[], const arm_real v[], const arm_real a[], arm_presliding *state,
                  arm_real tau[])
{
    arm_real direction[ARM_AXES];
    if (state) {
        slide_on(state, q, v);
    } else {
        of_axes(v, direction);
        for (int k = 0; k < ARM_AXES; k++) direction[k] = direction_of(k, direction[k]);
    }
    for (int j = 0; j < ARM_JOINTS; j++) tau[j] = 0;
    add_friction(q, v, a, state ? state->direction : direction, tau);
}

void arm_torque(const arm_real q[], const arm_real v[], const arm_real a[], arm_real tau[])
{
    arm_real dry[ARM_JOINTS];
    arm_rigid_torque(q, v, a, tau);
    arm_friction(q, v, a, 0, dry);
    for (int j = 0; j < ARM_JOINTS; j++) tau[j] += dry[j];
}

void arm_observer_start(arm_observer *observer, arm_real gain, arm_real dt, const arm_real q[],
                        const arm_real v[])
{
    arm_real bias[ARM_JOINTS];
    observer->gain = gain;
    arm_presliding_start(&observer->presliding, dt, q, v);
    momentum(q, v, observer->integral, bias);
    add_product(rotor, v, observer->integral);
    for (int j = 0; j < ARM_JOINTS; j++) observer->external[j] = 0;
}

void arm_observer_step(arm_observer *observer, const arm_real q[], const arm_real v[],
                       const arm_real tau[], arm_real external[])
{
    const arm_real dt = observer->presliding.dt, gain = observer->gain;
    arm_real impulse[ARM_JOINTS], bias[ARM_JOINTS], hold[ARM_JOINTS], dry[ARM_JOINTS];
    momentum(q, v, impulse, bias);
    add_product(rotor, v, impulse);
    arm_gravity(q, hold);
    arm_friction(q, v, 0, &observer->presliding, dry);
    for (int j = 0; j < ARM_JOINTS; j++) {
        /* the estimate acts on its own integral: implicit, stable for every gain */
        const arm_real sum = observer->integral[j] + dt * (tau[j] - dry[j] - hold[j] + bias[j]);
        observer->external[j] = gain * (impulse[j] - sum) / (1 + gain * dt);
        observer->integral[j] = sum + dt * observer->external[j];
        external[j] = observer->external[j];
    }
}
