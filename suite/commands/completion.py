"""The command `suite completion`: print the script with which a shell completes commands."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any, Literal

import tyro

from suite.common.console import Console
from suite.common.options import Command
from suite.common.usage import COMMANDS

BASH = """_suite() {{
    local word=${{COMP_WORDS[COMP_CWORD]}}
    if [ "$COMP_CWORD" -eq 1 ]; then
        COMPREPLY=($(compgen -W "{commands}" -- "$word"))
        return
    fi
    local options=
    case ${{COMP_WORDS[1]}} in
{cases}
    esac
    COMPREPLY=()
    case $word in -*) COMPREPLY=($(compgen -W "$options" -- "$word")) ;; esac
}}
complete -o default -F _suite suite
"""
"""Function of bash that completes names of commands and options; other words are completed as
files. `commands` and `cases` are filled in."""
ZSH = "#compdef suite\nautoload -U +X bashcompinit && bashcompinit\n"
"""Lines before it with which zsh runs a function of bash."""


@dataclass(frozen=True)
class Config(Command):
    """Print a script that completes commands and options, for bash or zsh.

    Write its output to ~/.local/share/bash-completion/completions/suite (bash), or to a file _suite
    in a folder of fpath (zsh).
    """

    shell: tyro.conf.Positional[Literal["bash", "zsh"]]
    """The shell: bash or zsh."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """Print the script for `config.shell`."""
    cases = (f'    {name}) options="{" ".join(options_of(name))}" ;;' for name in COMMANDS)
    script = BASH.format(commands=" ".join(COMMANDS), cases="\n".join(cases))
    script = script if config.shell == "bash" else ZSH + script
    console.say(script)
    return {"script": script}


def options_of(name: str) -> list[str]:
    """Return the options of a command, such as --track."""
    from suite.common.options import options

    command = importlib.import_module(f"suite.commands.{name}")
    return sorted({"--help", *(o.flag for o in options(command.Config) if not o.positional)})
