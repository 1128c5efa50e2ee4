/* Compares the actions of policy.c on this machine with those of its export. Exit 0: they agree. */
#include <stdio.h>

#include "policy.h"
#include "vectors.h"

int main(void)
{
    static policy_state state;
    float action[POLICY_ACTION_SIZE], worst = 0.0f;
    int wrong = 0;
    policy_reset(&state);
    for (int k = 0; k < VECTORS; k++) {
        policy_step(&state, observations[k], images[k], action);
        for (int j = 0; j < POLICY_ACTION_SIZE; j++) {
            const float error = action[j] - actions[k][j], size = error < 0.0f ? -error : error;
            wrong += !(size <= TOLERANCE); /* also for NaN */
            worst = size > worst ? size : worst;
        }
    }
    printf("%d steps, %d numbers wrong, largest error %g, allowed %g\n", VECTORS, wrong,
           (double)worst, (double)TOLERANCE);
    return wrong != 0;
}
