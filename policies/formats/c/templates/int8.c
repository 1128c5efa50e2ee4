
typedef signed char byte;
typedef char int_holds_the_sums[sizeof(int) >= 4 ? 1 : -1];

/* sums[BLOCK] += x[inputs] times weights; inputs is even. The sum of two products of bytes fits
 * into 16 bits, since weights are at least -127. Processors compute many such products at once, so
 * x has 16 bits as well. */
static void products(int *restrict sums, const short *restrict x, const byte *restrict weights,
                     int inputs)
{
    for (int i = 0; i < inputs; i += 2) {
        const short a = x[i], b = x[i + 1];
        const byte *v = weights + i * BLOCK, *w = v + BLOCK;
        for (int j = 0; j < BLOCK; j++) {
            sums[j] += (short)(a * v[j] + b * w[j]);
        }
    }
}

/* Rounds x * inverse + zero to whole numbers from -128 to 127; `zero` represents 0. */
static void to_bytes(short *restrict out, const float *restrict x, float inverse, int zero, int n)
{
    for (int i = 0; i < n; i++) {
        const float q = x[i] * inverse + (float)zero;
        const float c = q < -128.0f ? -128.0f : q > 127.0f ? 127.0f : q;
        out[i] = (short)(c < 0.0f ? c - 0.5f : c + 0.5f);
    }
}

/* out[outputs] += x[inputs] times weights, times scale; `offset` cancels the zero of x. */
static void dense(float *restrict out, const short *restrict x, const byte *restrict weights,
                  const float *restrict scale, const float *restrict offset, int inputs,
                  int outputs)
{
    for (int block = 0; block < outputs; block += BLOCK) {
        int sums[BLOCK] = {0};
        products(sums, x, weights + block * inputs, inputs);
        for (int j = 0; j < BLOCK; j++) {
            out[block + j] += (float)sums[j] * scale[block + j] + offset[block + j];
        }
    }
}

/* Maps 3 x 3 pixels of `inputs` channels to `outputs` channels, without padding. */
static void convolve(float *restrict out, const short *restrict x, const byte *restrict weights,
                     const float *restrict scale, const float *restrict offset, int rows,
                     int columns, int inputs, int outputs)
{
    const int wide = columns - 2, pixels = (rows - 2) * wide;
    for (int block = 0; block < outputs; block += BLOCK) {
        for (int pixel = 0; pixel < pixels; pixel++) {
            const short *from = x + (pixel / wide * columns + pixel % wide) * inputs;
            const byte *w = weights + block * 9 * inputs;
            int sums[BLOCK] = {0};
            for (int row = 0; row < 3; row++) {
                products(sums, from + row * columns * inputs, w + row * 3 * inputs * BLOCK,
                         3 * inputs);
            }
            for (int j = 0; j < BLOCK; j++) {
                out[pixel * outputs + block + j] =
                    leaky((float)sums[j] * scale[block + j] + offset[block + j]);
            }
        }
    }
}

void policy_step(policy_state *state, const float *observation, const float *image, float *action)
{
    float *const first = state->first, *const second = state->second;
    float *const embedding = second, *const from_input = first, *const from_hidden = state->gates;
    short *const bytes = state->bytes;
    if (refused(observation, image, action)) {
        return;
    }
    pool(second, image);
    first_layer(first, second);
    to_bytes(bytes, first, CONV2_INVERSE, CONV2_ZERO, ROWS1 * COLUMNS1 * CHANNELS1);
    convolve(second, bytes, conv2_weight, conv2_scale, conv2_offset, ROWS1, COLUMNS1, CHANNELS1,
             CHANNELS2);
    to_bytes(bytes, second, CONV3_INVERSE, CONV3_ZERO, ROWS2 * COLUMNS2 * CHANNELS2);
    convolve(first, bytes, conv3_weight, conv3_scale, conv3_offset, ROWS2, COLUMNS2, CHANNELS2,
             CHANNELS3);
    to_bytes(bytes, first, IMAGE_INVERSE, IMAGE_ZERO, FEATURES);
    embed_state(embedding, observation);
    dense(embedding, bytes, image_weight, image_scale, image_offset, FEATURES, PADDED);
    activate(embedding);
    for (int j = 0; j < GATES; j++) {
        from_input[j] = gru_input_bias[j];
        from_hidden[j] = gru_hidden_bias[j];
    }
    to_bytes(bytes, embedding, GRU_INPUT_INVERSE, GRU_INPUT_ZERO, PADDED);
    dense(from_input, bytes, gru_input_weight, gru_input_scale, gru_input_offset, PADDED, GATES);
    to_bytes(bytes, state->hidden, GRU_HIDDEN_INVERSE, GRU_HIDDEN_ZERO, PADDED);
    dense(from_hidden, bytes, gru_hidden_weight, gru_hidden_scale, gru_hidden_offset, PADDED,
          GATES);
    gru(state->hidden, from_input, from_hidden);
    act(action, state->hidden);
}
