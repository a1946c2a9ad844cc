/* model: one step of a fitted model, every 1.0 s.
 * Written by orthaug.
 * Model sha256 aa1eba6d5c5bdfe04c76ce813c59e6a535cb5989523663765bbd65ebc57f9969
 *
 *   u[0]  u
 *   y[0]  y
 */
#ifndef MODEL_H
#define MODEL_H

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

#ifdef MODEL_FLOAT
typedef float model_real;
#else
typedef double model_real;
#endif

#define MODEL_INPUTS 1
#define MODEL_OUTPUTS 1
#define MODEL_STATES 2

typedef struct {
    model_real y[1]; /* y[k-1] */
    model_real u[1]; /* u[k-1] */
    int flag; /* 1 where the last step met NaN or infinity; the state was left as it was then */
} model_state;

/* A state of zeros. */
void model_start(model_state *state);

/* One sample: outputs y of inputs u, and the next state. */
void model_step(model_state *state, const model_real u[], model_real y[]);

/* n samples, row after row; how many of them were flagged. */
size_t model_run(model_state *state, const model_real u[], model_real y[], size_t n);

#ifdef __cplusplus
}
#endif

#endif
