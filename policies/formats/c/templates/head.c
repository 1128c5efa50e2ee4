/* $NAME, $DTYPE. See policy.h. Written by diffracing-suite $VERSION: do not edit. */
#include <math.h>

#include "policy.h"

#if POLICY_EXPORT != $EXPORT
#error "policy.h and policy.c are of two exports: copy both files of one export"
#endif
#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__
#error "-ffast-math removes the checks for NaN: leave it out, or add -fno-finite-math-only"
#endif

enum {
    HEIGHT = POLICY_IMAGE_HEIGHT,
    WIDTH = POLICY_IMAGE_WIDTH,
    ROWS1 = HEIGHT / 4,
    COLUMNS1 = WIDTH / 4,
    ROWS2 = ROWS1 - 2,
    COLUMNS2 = COLUMNS1 - 2,
    ROWS3 = ROWS2 - 2,
    COLUMNS3 = COLUMNS2 - 2,
    CHANNELS1 = $CHANNELS1,
    CHANNELS2 = $CHANNELS2,
    CHANNELS3 = $CHANNELS3,
    FEATURES = ROWS3 * COLUMNS3 * CHANNELS3,
    INPUTS = POLICY_STATE_SIZE,
    HIDDEN = $HIDDEN_SIZE, /* units */
    PADDED = $PADDED,      /* HIDDEN padded with zeros to a multiple of BLOCK */
    GATES = $GATES,        /* 3 HIDDEN padded in the same way */
    BLOCK = 32             /* outputs whose weights are neighbours in memory */
};

