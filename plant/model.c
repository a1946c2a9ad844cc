/* model: one step of a fitted model (see the header). Written by orthaug. */
#include "model.h"

#include <math.h>

typedef model_real real;
#define R(number) ((real)(number))

#ifdef MODEL_FLOAT
#define tanh_ tanhf
#else
#define tanh_ tanh
#endif
static real least(real a, real b) { return a < b || isnan(a) ? a : b; }
static real largest(real a, real b) { return a > b || isnan(a) ? a : b; }

static const real p_a = R(0.7016483508988269); /* a, theta */
static const real p_a_aux = R(0.0016382218080673693); /* a, theta_aux */
static const real p_b = R(0.6818187759462153); /* b, theta */
static const real p_b_aux = R(0.1811817645301655); /* b, theta_aux */

static real act_tanh(real a) { return tanh_(a); }

static const real output_w1[4][2] = {
    {R(-0.0011176011889785073), R(-0.0018497107945751393)},
    {R(-0.0006643964756514388), R(3.423751570868883)},
    {R(2.9054646693241834e-05), R(4.810979095754063e-05)},
    {R(-9.717028931386924e-05), R(-0.00016089814840747292)}
};
static const real output_b1[4] = {
    R(-0.01790775015532717), R(-0.3525911074594549), R(0.0004658338299509423), R(-0.0015579320259005635)
};
static const real output_w2[1][4] = {
    {R(0.009491857226829796), R(0.2987788117619893), R(-0.0002504904890499268), R(0.0008303605392990614)}
};
static const real output_b2[1] = {
    R(-3.8420692223806244e-13)
};

static void output_learner(const real z[2], real g[1])
{
    real h1[4];
    int i, j;
    for (i = 0; i < 4; i++) {
        real sum = output_b1[i];
        for (j = 0; j < 2; j++) sum += output_w1[i][j] * z[j];
        h1[i] = act_tanh(sum);
    }
    for (i = 0; i < 1; i++) {
        real sum = output_b2[i];
        for (j = 0; j < 4; j++) sum += output_w2[i][j] * h1[j];
        g[i] = sum;
    }
}

void model_start(model_state *state)
{
    int i;
    for (i = 0; i < 1; i++) state->y[i] = 0;
    for (i = 0; i < 1; i++) state->u[i] = 0;
    state->flag = 0;
}

void model_step(model_state *state, const model_real u[], model_real y[])
{
    int i, ok = 1;
    {
        const real h_seen_0 = state->y[0];
        const real h_seen_1 = state->u[0];
        const real h_inside_0 = least(largest(h_seen_0, R(-4.82007713892934)), R(4.4352335424889535));
        const real h_inside_1 = least(largest(h_seen_1, R(-5.481853129915642)), R(4.775614712841804));
        const real h_point_0 = state->y[0] + R(0.9999999999999994)*(h_inside_0 - h_seen_0);
        const real h_point_1 = state->u[0] + R(1.0)*(h_inside_1 - h_seen_1);
        real z[2], g[1];
        z[0] = (h_inside_0 - (R(-0.19242179822019345)))/R(3.085103560472765);
        z[1] = (h_inside_1 - (R(-0.3531192085369186)))/R(3.419155947585815);
        output_learner(z, g);
        y[0] = p_a*state->y[0] + p_b*state->u[0] + (g[0] + (-(p_a_aux*h_point_0)) + (-(p_b_aux*h_point_1)));
    }
    for (i = 0; i < 1; i++) ok = ok && isfinite(u[i]);
    for (i = 0; i < 1; i++) ok = ok && isfinite(y[i]);
    state->flag = !ok;
    if (!ok) return;
    state->y[0] = y[0];
    state->u[0] = u[0];
}

size_t model_run(model_state *state, const model_real u[], model_real y[], size_t n)
{
    size_t k, flagged = 0;
    for (k = 0; k < n; k++) {
        model_step(state, u + k * MODEL_INPUTS, y + k * MODEL_OUTPUTS);
        flagged += (size_t)state->flag;
    }
    return flagged;
}
