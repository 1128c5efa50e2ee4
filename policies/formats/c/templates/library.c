/* Functions by which diffracing-suite calls a compiled policy.c, also one that it did not write. */
#include <stddef.h>

#include "policy.h"

#ifndef POLICY_ACTION_SIZE
#define POLICY_ACTION_SIZE 0 /* unknown */
#endif

int suite_size(int which)
{
    const int sizes[] = {(int)sizeof(policy_state), POLICY_STATE_SIZE, POLICY_IMAGE_HEIGHT,
                         POLICY_IMAGE_WIDTH, POLICY_ACTION_SIZE};
    return sizes[which];
}

const char *suite_json(void)
{
#ifdef POLICY_JSON
    return POLICY_JSON;
#else
    return "";
#endif
}

void suite_rows(int rows, int action_size, policy_state *states, const unsigned char *fresh,
                const float *observations, const float *images, float *actions)
{
    for (int k = 0; k < rows; k++) {
        if (fresh[k]) {
            policy_reset(states + k);
        }
        policy_step(states + k, observations + (size_t)k * POLICY_STATE_SIZE,
                    images + (size_t)k * POLICY_IMAGE_HEIGHT * POLICY_IMAGE_WIDTH,
                    actions + (size_t)k * (size_t)action_size);
    }
}
