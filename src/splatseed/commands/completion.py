"""``splatseed --completion``: a script by which a shell completes verbs and options.

Promise: the options are those of the verbs; if none matches what was typed, files are offered.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from splatseed.commands.options import known_options
from splatseed.commands.spelling import options_of
from splatseed.errors import ParameterError

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
    options = {verb: options_of(verb) for verb in verbs}
    for name, kind in _reports().items():
        options[f"bench {name}"] = known_options(kind)
    return (ZSH if words[0] == "zsh" else "") + _bash(verbs, options)


def _reports() -> Mapping[str, type]:
    """The words that may follow ``bench``, with their options."""
    from splatseed.commands.bench.report import CompareOptions, ReportOptions  # noqa: PLC0415

    return {"report": ReportOptions, "compare": CompareOptions}


def _bash(verbs: Sequence[str], options: Mapping[str, Sequence[str]]) -> str:
    """A function for bash.

    Args:
        verbs: All verbs.
        options: By verb, and by "VERB WORD" where a word follows the verb.
    """
    two = [name for name in options if " " in name]  # the longer patterns come first
    cases = "".join(
        f"    '{name} '*) words='{' '.join(options[name])}' ;;\n" for name in [*two, *verbs]
    )
    follow = "".join(
        f"  if [ \"$COMP_CWORD:${{COMP_WORDS[1]}}\" = '2:{verb}' ]; then words+=' {word}'; fi\n"
        for verb, _, word in (name.partition(" ") for name in two)
    )
    return f"""\
_splatseed() {{
  local current=${{COMP_WORDS[COMP_CWORD]}} words=''
  case "${{COMP_WORDS[*]:1:2}} " in
{cases}  esac
{follow}\
  if [ "$COMP_CWORD" -eq 1 ]; then words='{" ".join(verbs)} --help --version'; fi
  COMPREPLY=($(compgen -W "$words" -- "$current"))
  if [ -z "$current" ] && [ "$COMP_CWORD" -gt 1 ]; then COMPREPLY=(); fi
}}
{FILES}
"""
