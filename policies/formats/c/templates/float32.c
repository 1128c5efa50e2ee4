
/* Eight sums are kept in vector registers if the compiler supports vectors, else in floats. */
#if !defined(POLICY_PLAIN) && defined(__GNUC__) && defined(__AVX512F__)
enum { LANES = 16 };
typedef float vector __attribute__((vector_size(64), aligned(4), may_alias));
#elif !defined(POLICY_PLAIN) && defined(__GNUC__) && defined(__AVX__)
enum { LANES = 8 };
typedef float vector __attribute__((vector_size(32), aligned(4), may_alias));
#elif !defined(POLICY_PLAIN) && defined(__GNUC__) && (defined(__SSE__) || defined(__ARM_NEON))
enum { LANES = 4 };
typedef float vector __attribute__((vector_size(16), aligned(4), may_alias));
#else
enum { LANES = 1 };
typedef float vector;
#endif
enum {
    SPAN = 8 * LANES,                          /* products at a time */
    PART = SPAN < BLOCK ? SPAN : BLOCK,        /* outputs at a time */
    EACH = SPAN < BLOCK ? 1 : SPAN / BLOCK,    /* inputs at a time */
    VECTORS = PART / LANES                     /* vectors of one input's products */
};

static vector load(const float *from)
{
    return *(const vector *)from;
}

static void store(float *to, vector value)
{
    *(vector *)to = value;
}

/* out[outputs] += x[inputs] times weights; inputs is a multiple of 4. `backwards` reverses the order
 * of the blocks (see policy_step), which does not change the result. */
static void dense(float *restrict out, const float *restrict x, const float *restrict weights,
                  int inputs, int outputs, int backwards)
{
    for (int done = 0; done < outputs; done += BLOCK) {
        const int block = backwards ? outputs - BLOCK - done : done;
        for (int part = block; part < block + BLOCK; part += PART) {
            const float *w = weights + block * inputs + (part - block);
            const vector zero = load(zeros);
            vector s0 = zero, s1 = zero, s2 = zero, s3 = zero;
            vector s4 = zero, s5 = zero, s6 = zero, s7 = zero;
            float sums[SPAN];
            for (int i = 0; i < inputs; i += EACH) {
                s0 += x[i + 0 / VECTORS] * load(w + 0 * LANES);
                s1 += x[i + 1 / VECTORS] * load(w + 1 * LANES);
                s2 += x[i + 2 / VECTORS] * load(w + 2 * LANES);
                s3 += x[i + 3 / VECTORS] * load(w + 3 * LANES);
                s4 += x[i + 4 / VECTORS] * load(w + 4 * LANES);
                s5 += x[i + 5 / VECTORS] * load(w + 5 * LANES);
                s6 += x[i + 6 / VECTORS] * load(w + 6 * LANES);
                s7 += x[i + 7 / VECTORS] * load(w + 7 * LANES);
                w += EACH * BLOCK;
            }
            store(sums + 0 * LANES, s0);
            store(sums + 1 * LANES, s1);
            store(sums + 2 * LANES, s2);
            store(sums + 3 * LANES, s3);
            store(sums + 4 * LANES, s4);
            store(sums + 5 * LANES, s5);
            store(sums + 6 * LANES, s6);
            store(sums + 7 * LANES, s7);
            for (int k = 0; k < EACH; k++) {
                for (int j = 0; j < PART; j++) {
                    out[part + j] += sums[k * PART + j];
                }
            }
        }
    }
}

/* Maps 3 x 3 pixels of `inputs` channels to `outputs` channels, without padding, four pixels and
 * two vectors at a time. The last pixel is repeated to complete the last four. */
static void convolve(float *restrict out, const float *restrict x, const float *restrict weights,
                     int rows, int columns, int inputs, int outputs)
{
    const int wide = columns - 2, pixels = (rows - 2) * wide;
    for (int block = 0; block < outputs; block += BLOCK) {
        for (int first = 0; first < pixels; first += 4) {
            int at[4];
            const float *from[4];
            for (int p = 0; p < 4; p++) {
                const int pixel = first + p < pixels ? first + p : pixels - 1;
                at[p] = pixel * outputs;
                from[p] = x + (pixel / wide * columns + pixel % wide) * inputs;
            }
            for (int part = block; part < block + BLOCK; part += 2 * LANES) {
                const float *w = weights + block * 9 * inputs + (part - block);
                const vector zero = load(zeros);
                vector s00 = zero, s01 = zero, s10 = zero, s11 = zero;
                vector s20 = zero, s21 = zero, s30 = zero, s31 = zero;
                float sums[8 * LANES];
                for (int row = 0; row < 3; row++) {
                    const float *a = from[0] + row * columns * inputs;
                    const float *b = from[1] + row * columns * inputs;
                    const float *c = from[2] + row * columns * inputs;
                    const float *d = from[3] + row * columns * inputs;
                    for (int i = 0; i < 3 * inputs; i++) {
                        const vector v0 = load(w), v1 = load(w + LANES);
                        s00 += a[i] * v0;
                        s01 += a[i] * v1;
                        s10 += b[i] * v0;
                        s11 += b[i] * v1;
                        s20 += c[i] * v0;
                        s21 += c[i] * v1;
                        s30 += d[i] * v0;
                        s31 += d[i] * v1;
                        w += BLOCK;
                    }
                }
                store(sums + 0 * LANES, s00);
                store(sums + 1 * LANES, s01);
                store(sums + 2 * LANES, s10);
                store(sums + 3 * LANES, s11);
                store(sums + 4 * LANES, s20);
                store(sums + 5 * LANES, s21);
                store(sums + 6 * LANES, s30);
                store(sums + 7 * LANES, s31);
                for (int p = 0; p < 4; p++) {
                    for (int j = 0; j < 2 * LANES; j++) {
                        out[at[p] + part + j] = leaky(sums[p * 2 * LANES + j]);
                    }
                }
            }
        }
    }
}

/* Computes the contribution of the hidden state to the gates. */
static void gates_from_hidden(policy_state *state)
{
    for (int j = 0; j < GATES; j++) {
        state->gates[j] = gru_hidden_bias[j];
    }
    dense(state->gates, state->hidden, gru_hidden_weight, PADDED, GATES, state->odd);
}

void policy_step(policy_state *state, const float *observation, const float *image, float *action)
{
    float *const first = state->first, *const second = state->second;
    float *const embedding = second, *const from_input = first;
    if (refused(observation, image, action)) {
        return;
    }
    /* Every second step uses the weights in the opposite order, and so begins with those that the
     * step before used last. They are still in the processor's cache, which may be slightly too
     * small for all weights. The result is the same. */
    state->odd = !state->odd;
    if (state->odd) {
        gates_from_hidden(state);
    }
    pool(second, image);
    first_layer(first, second);
    convolve(second, first, conv2_weight, ROWS1, COLUMNS1, CHANNELS1, CHANNELS2);
    convolve(first, second, conv3_weight, ROWS2, COLUMNS2, CHANNELS2, CHANNELS3);
    embed_state(embedding, observation);
    dense(embedding, first, image_weight, FEATURES, PADDED, state->odd);
    activate(embedding);
    for (int j = 0; j < GATES; j++) {
        from_input[j] = gru_input_bias[j];
    }
    dense(from_input, embedding, gru_input_weight, PADDED, GATES, state->odd);
    if (!state->odd) {
        gates_from_hidden(state);
    }
    gru(state->hidden, from_input, state->gates);
    act(action, state->hidden);
}
