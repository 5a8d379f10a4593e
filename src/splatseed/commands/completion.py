"""``splatseed --completion``: a script by which a shell completes verbs and options.

Promise: the options are those of the verbs; if none matches what was typed, files are offered.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module

from splatseed.commands.options import known_options
from splatseed.errors import ParameterError

__all__ = ["completion_script"]

SHELLS = ("bash", "zsh")
FILES = "complete -o default -F _splatseed splatseed"
ZSH = "autoload -U +X bashcompinit && bashcompinit\n"
"""Lets zsh read a script for bash."""


def completion_script(words: Sequence[str], verbs: Sequence[str]) -> str:
    """The script for a shell.

    Args:
        words: The shell's name.
        verbs: All verbs.

    Raises:
        ParameterError: It is an unknown shell, or none is named.
    """
    if len(words) != 1 or words[0] not in SHELLS:
        raise ParameterError(
            f"--completion {' or '.join(SHELLS)}",
            found=" ".join(words) or "no shell",
            fix='For bash: eval "$(splatseed --completion bash)" in ~/.bashrc.',
        )
    options = {verb: known_options(_options_of(verb)) for verb in verbs}
    return (ZSH if words[0] == "zsh" else "") + _bash(options)


def _options_of(verb: str) -> type:
    options: type = import_module(f"splatseed.commands.{verb}").Options
    return options


def _bash(options: Mapping[str, Sequence[str]]) -> str:
    cases = "".join(
        f"    {verb}) words='{' '.join(known)}' ;;\n" for verb, known in options.items()
    )
    return f"""\
_splatseed() {{
  local current=${{COMP_WORDS[COMP_CWORD]}} words=''
  case ${{COMP_WORDS[1]}} in
{cases}  esac
  if [ "$COMP_CWORD" -eq 1 ]; then words='{" ".join(options)} --help --version'; fi
  case $COMP_CWORD$current in
    1*|*-*) COMPREPLY=($(compgen -W "$words" -- "$current")) ;;
    *) COMPREPLY=() ;;
  esac
}}
{FILES}
"""
