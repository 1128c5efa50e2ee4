
static float leaky(float x)
{
    return x > 0.0f ? x : $LEAK * x;
}

/* Lambert's continued fraction of tanh (1768), cut at 12 terms; the error is below 4e-7. */
static float tanh_of(float x)
{
    const float c = x < -8.0f ? -8.0f : x > 8.0f ? 8.0f : x;
    const float s = c * c;
    const float p = $TANH_P;
    const float q = $TANH_Q;
    return c * p / q;
}

static float sigmoid(float x)
{
    return 0.5f + 0.5f * tanh_of(0.5f * x);
}

static int all_finite(const float *x, int n)
{
    int bad = 0;
    for (int i = 0; i < n; i++) {
        bad |= !isfinite(x[i]);
    }
    return !bad;
}

/* Returns whether an input is not finite; the action is then set to NaN. */
static int refused(const float *observation, const float *image, float *action)
{
    const int bad = !all_finite(observation, INPUTS) || !all_finite(image, HEIGHT * WIDTH);
    for (int k = 0; bad && k < POLICY_ACTION_SIZE; k++) {
        action[k] = NAN;
    }
    return bad;
}

/* Takes the largest of every 2 x 2 pixels, so that near objects remain. */
static void pool(float *restrict out, const float *restrict image)
{
    for (int row = 0; row < HEIGHT / 2; row++) {
        const float *a = image + 2 * row * WIDTH, *b = a + WIDTH;
        for (int column = 0; column < WIDTH / 2; column++) {
            const float upper = a[2 * column] > a[2 * column + 1] ? a[2 * column] : a[2 * column + 1];
            const float lower = b[2 * column] > b[2 * column + 1] ? b[2 * column] : b[2 * column + 1];
            out[row * (WIDTH / 2) + column] = upper > lower ? upper : lower;
        }
    }
}

/* Maps 2 x 2 pixels to CHANNELS1 numbers, with stride 2. */
static void first_layer(float *restrict out, const float *restrict x)
{
    for (int row = 0; row < ROWS1; row++) {
        for (int column = 0; column < COLUMNS1; column++) {
            const float *a = x + 2 * row * (WIDTH / 2) + 2 * column, *b = a + WIDTH / 2;
            const float x0 = a[0], x1 = a[1], x2 = b[0], x3 = b[1];
            float *y = out + (row * COLUMNS1 + column) * CHANNELS1;
            for (int j = 0; j < CHANNELS1; j++) {
                y[j] = leaky(x0 * conv1_weight[j] + x1 * conv1_weight[CHANNELS1 + j] +
                             x2 * conv1_weight[2 * CHANNELS1 + j] +
                             x3 * conv1_weight[3 * CHANNELS1 + j]);
            }
        }
    }
}

/* Computes the embedding of the state. */
static void embed_state(float *restrict out, const float *restrict observation)
{
    for (int j = 0; j < PADDED; j++) {
        out[j] = state_bias[j];
    }
    for (int i = 0; i < INPUTS; i++) {
        for (int j = 0; j < PADDED; j++) {
            out[j] += observation[i] * state_weight[i * PADDED + j];
        }
    }
}

static void activate(float *embedding)
{
    for (int j = 0; j < PADDED; j++) {
        embedding[j] = leaky(embedding[j]);
    }
}

/* Updates the gated recurrent unit; its gates reset, update and new have HIDDEN numbers each. */
static void gru(float *restrict hidden, const float *restrict from_input,
                const float *restrict from_hidden)
{
    for (int j = 0; j < HIDDEN; j++) {
        const float reset = sigmoid(from_input[j] + from_hidden[j]);
        const float update = sigmoid(from_input[HIDDEN + j] + from_hidden[HIDDEN + j]);
        const float fresh = tanh_of(from_input[2 * HIDDEN + j] + reset * from_hidden[2 * HIDDEN + j]);
        hidden[j] = fresh + update * (hidden[j] - fresh);
    }
}

static void act(float *action, const float *hidden)
{
    float sum[POLICY_ACTION_SIZE] = {0.0f};
    for (int j = 0; j < HIDDEN; j++) {
        const float x = leaky(hidden[j]);
        for (int k = 0; k < POLICY_ACTION_SIZE; k++) {
            sum[k] += x * action_weight[j * POLICY_ACTION_SIZE + k];
        }
    }
    for (int k = 0; k < POLICY_ACTION_SIZE; k++) {
        action[k] = sum[k];
    }
}

void policy_reset(policy_state *state)
{
    for (int j = 0; j < PADDED; j++) {
        state->hidden[j] = 0.0f;
    }
    state->odd = 0;
}
