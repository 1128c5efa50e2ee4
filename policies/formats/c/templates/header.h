/*
 * $NAME: a drone racing policy, written by diffracing-suite $VERSION.
 * It has $WEIGHTS weights of type $DTYPE.
 *
 * Call policy_reset once before a flight, then policy_step $RATE times a second.
 *
 *   observation[POLICY_STATE_SIZE], not scaled. Body axes: x forward, y left, z up, origin at the
 *   centre of mass; world: z up; R is the rotation from body to world.
$OBSERVATION
 *
 *   image[POLICY_IMAGE_HEIGHT * POLICY_IMAGE_WIDTH], row by row, row 0 at the top, column 0 at the
 *   left. The camera is at the body's origin and looks forward, pitched up by
 *   POLICY_CAMERA_PITCH_DEG; its field of view from edge to edge is POLICY_CAMERA_FOV_*_DEG. A
 *   pixel is the planar depth d in metres (along the camera's axis, not along the ray), encoded as
 *       POLICY_DEPTH_SCALE / clip(d, POLICY_DEPTH_NEAR, POLICY_DEPTH_FAR) - POLICY_DEPTH_OFFSET
 *   If nothing is in range, d is POLICY_DEPTH_FAR. d is the smallest depth of POLICY_CAMERA_RAYS x
 *   POLICY_CAMERA_RAYS rays, each through the centre of a part of the pixel.
 *
 *   action[POLICY_ACTION_SIZE]: $ACTION
 *
 * If an input is not finite, the action is NaN (do not fly it) and the state is unchanged.
 * A step takes $MACS multiply-adds, $WEIGHT_BYTES bytes of constants, sizeof(policy_state) bytes
 * of the caller's memory and a few hundred bytes of stack. It needs IEEE floats: no -ffast-math.
 */
#ifndef POLICY_H
#define POLICY_H

#define POLICY_STATE_SIZE $STATE_SIZE
#define POLICY_IMAGE_HEIGHT $HEIGHT
#define POLICY_IMAGE_WIDTH $WIDTH
#define POLICY_ACTION_SIZE $ACTION_SIZE

#define POLICY_RATE_HZ $RATE_LITERAL
#define POLICY_CAMERA_PITCH_DEG $PITCH
#define POLICY_CAMERA_FOV_H_DEG $FOV_H
#define POLICY_CAMERA_FOV_V_DEG $FOV_V
#define POLICY_CAMERA_RAYS $RAYS
#define POLICY_DEPTH_SCALE $DEPTH_SCALE
#define POLICY_DEPTH_NEAR $DEPTH_NEAR
#define POLICY_DEPTH_FAR $DEPTH_FAR
#define POLICY_DEPTH_OFFSET $DEPTH_OFFSET

/* SHA-256 of the checkpoint's weights.safetensors and of the contract; metadata for the suite. */
#define POLICY_CHECKPOINT_SHA256 "$SHA256"
#define POLICY_CONTRACT_SHA256 "$CONTRACT"
#define POLICY_EXPORT $EXPORT /* policy.c has the same number */
#define POLICY_JSON \
$JSON

#ifdef __cplusplus
extern "C" {
#endif

/* The state between steps, and the working memory of a step. The caller owns it. */
typedef struct {
    float hidden[$PADDED]; /* kept between steps: the recurrent state */
    int odd; /* kept between steps: whether the number of steps so far is odd */
    float gates[$GATES]; /* used within a step, as the following arrays */
    float first[$FIRST];
    float second[$SECOND];
$EXTRA_STATE} policy_state;

void policy_reset(policy_state *state);
void policy_step(policy_state *state, const float *observation, const float *image, float *action);

#ifdef __cplusplus
}
#endif

#endif
