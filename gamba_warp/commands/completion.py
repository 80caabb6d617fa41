"""``gamba completion``: completion of commands, options and values by Tab."""

from __future__ import annotations

from typing import Literal

import tyro

# Each calls ``gamba --complete WORDS`` with the words so far; without an answer, files complete.
SCRIPTS = {
    "bash": """\
_gamba() {
  local IFS=$'\\n'
  COMPREPLY=($(gamba --complete "${COMP_WORDS[@]:1:COMP_CWORD}" 2>/dev/null))
}
complete -o default -F _gamba gamba""",
    "zsh": """\
_gamba() {
  local -a found
  found=(${(f)"$(gamba --complete "${(@)words[2,CURRENT]}" 2>/dev/null)"})
  if (( $#found )); then compadd -a found; else _files; fi
}
whence compdef >/dev/null || { autoload -Uz compinit && compinit }
compdef _gamba gamba""",
    "fish": """\
complete -c gamba -a \
'(gamba --complete (commandline -opc)[2..-1] (commandline -ct) 2>/dev/null)'""",
}


def completion_command(shell: tyro.conf.Positional[Literal["bash", "zsh", "fish"]]) -> None:
    """Print the script by which a shell completes commands, options and values by Tab.

    bash: eval "$(gamba completion bash)" in ~/.bashrc; zsh: the same with zsh in ~/.zshrc; fish:
    gamba completion fish | source in ~/.config/fish/config.fish.

    Args:
        shell: The shell.
    """
    print(SCRIPTS[shell])
