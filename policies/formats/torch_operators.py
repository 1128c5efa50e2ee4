"""The torch operators that a program may use without being trusted: arithmetic on tensors.

None of them reads or writes a file, prints, allocates by another's memory or calls back into
Python. Any overload of a name is allowed.
"""

_ARITHMETIC = """
abs add sub rsub mul div neg pow sqrt rsqrt exp expm1 log log1p log2 sin cos tan asin acos atan
atan2 sinh cosh square reciprocal sign sgn floor ceil round trunc frac fmod remainder floor_divide
maximum minimum clamp clamp_min clamp_max where lerp addcmul addcdiv erf hypot deg2rad rad2deg
nan_to_num isnan isinf isfinite eq ne lt le gt ge logical_and logical_or logical_not logical_xor
bitwise_and bitwise_or bitwise_not
"""
_PRODUCTS = """
mm bmm matmul addmm baddbmm addbmm addmv mv dot linear einsum outer bilinear
scaled_dot_product_attention
"""
_REDUCTIONS = """
sum mean amax amin max min argmax argmin prod std var norm linalg_vector_norm linalg_norm
linalg_cross cross cumsum cumprod logsumexp softmax log_softmax _softmax any all sort topk
"""
_SHAPES = """
view _unsafe_view reshape flatten unflatten unsqueeze squeeze permute transpose t expand expand_as
cat concat stack hstack vstack split split_with_sizes chunk unbind slice select narrow index
index_select gather roll flip repeat tile repeat_interleave pad constant_pad_nd
reflection_pad2d replication_pad2d movedim swapaxes contiguous clone alias detach detach_ to
_to_copy type_as lift_fresh_copy lift_fresh zeros ones full empty zeros_like ones_like full_like
empty_like new_zeros new_ones new_full arange linspace eye tril triu meshgrid sym_size sym_numel
scalar_tensor masked_fill copy copy_ slice_scatter select_scatter unfold pixel_shuffle
"""
_LAYERS = """
conv1d conv2d conv3d convolution conv_transpose2d _convolution max_pool1d max_pool2d
max_pool2d_with_indices avg_pool1d avg_pool2d adaptive_avg_pool2d _adaptive_avg_pool2d
adaptive_max_pool2d relu relu_ relu6 leaky_relu leaky_relu_ elu elu_ celu selu gelu silu
silu_ mish softplus softsign sigmoid tanh hardtanh hardtanh_ hardsigmoid hardswish hardswish_
logsigmoid log_sigmoid_forward glu prelu _prelu_kernel threshold softshrink hardshrink tanhshrink
dropout feature_dropout alpha_dropout batch_norm _native_batch_norm_legit_no_training
_native_batch_norm_legit layer_norm native_layer_norm group_norm native_group_norm instance_norm
rms_norm embedding gru gru_cell lstm lstm_cell rnn_tanh rnn_relu rnn_tanh_cell rnn_relu_cell
upsample_nearest2d upsample_bilinear2d one_hot
"""
_CHECKS = """
sym_constrain_range_for_size sym_constrain_range _assert_scalar _assert_tensor_metadata
"""

ATEN = frozenset((_ARITHMETIC + _PRODUCTS + _REDUCTIONS + _SHAPES + _LAYERS + _CHECKS).split())
"""Names in `torch.ops.aten`."""
PYTHON = frozenset("add sub mul floordiv mod neg eq ne lt le gt ge getitem".split())
"""Names in Python's `operator` module: arithmetic on sizes, picking one of several outputs."""
