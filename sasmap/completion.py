"""Scripts that complete sasmap's commands in a shell, made from its parser."""

from __future__ import annotations

import argparse

_BASH = """\
_sasmap() {{
  local word="${{COMP_WORDS[COMP_CWORD]}}" words
  if [ "$COMP_CWORD" -eq 1 ]; then
    words="{verbs}"
  else
    case "${{COMP_WORDS[1]}}" in
{cases}
    esac
  fi
  COMPREPLY=($(compgen -W "$words" -- "$word") $(compgen -f -- "$word"))
}}
complete -o filenames -F _sasmap sasmap
"""


def script(parser: argparse.ArgumentParser, shell: str) -> str:
    """Return the script of a shell.

    Parameters
    ----------
    parser : ArgumentParser
        With a parser for each verb.
    shell : str
        bash, zsh or fish.

    Returns
    -------
    str
    """
    verbs = _verbs(parser)
    if shell == "fish":
        lines = [f"complete -c sasmap -n __fish_use_subcommand -a {verb}" for verb in verbs]
        for verb, options in verbs.items():
            seen = f"-n '__fish_seen_subcommand_from {verb}'"
            lines += [
                f"complete -c sasmap {seen} -l {o[2:]}" if o.startswith("--")
                else f"complete -c sasmap {seen} -a {o}"
                for o in options
            ]  # fmt: skip
        return "\n".join(lines) + "\n"
    cases = "\n".join(f'      {v}) words="{" ".join(o)}" ;;' for v, o in verbs.items())
    text = _BASH.format(verbs=" ".join(verbs), cases=cases)
    start = "autoload -U +X bashcompinit && bashcompinit\n" if shell == "zsh" else ""
    return start + text


def _verbs(parser: argparse.ArgumentParser) -> dict[str, list[str]]:
    """Options, and arguments with a choice, of each verb."""
    parsers = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    found: dict[str, list[str]] = {}
    for verb, one in parsers.choices.items():
        words: list[str] = []
        for action in one._actions:
            words += [o for o in action.option_strings if o.startswith("--")]
            words += [] if action.option_strings else list(action.choices or ())
        found[verb] = words
    return found
