"""The diagnosis's benchmark without its packages."""

import pytest

from suite.experiments.bench import diagnose, sysid_baseline


def test_without_its_packages_the_command_says_what_to_install(monkeypatch):
    from suite.common.errors import WorkFailed

    monkeypatch.setattr(sysid_baseline, "is_installed", lambda: False)
    with pytest.raises(WorkFailed, match=r"pip install 'mujoco\[sysid\]'"):
        diagnose.run()
