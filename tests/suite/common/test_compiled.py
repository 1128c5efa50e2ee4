"""Compiled programs are kept where the user's cache is, unless the user said otherwise."""

from suite.common.compiled import keep_compiled


def test_the_users_cache_is_used_and_a_setting_is_left_alone() -> None:
    own = {"XDG_CACHE_HOME": "/home/ada/.cache"}
    keep_compiled(own)
    assert own["JAX_COMPILATION_CACHE_DIR"].startswith("/home/ada/.cache/diffracing-suite/jax/")
    off = {"JAX_COMPILATION_CACHE_DIR": "", "TF_CPP_MIN_LOG_LEVEL": "0"}
    keep_compiled(off)
    assert off == {"JAX_COMPILATION_CACHE_DIR": "", "TF_CPP_MIN_LOG_LEVEL": "0"}
