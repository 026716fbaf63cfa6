"""CPU time of the starts: `import romandask`, help, version, completion, the first use of a survey, and a plan.

python tests/benchmarks/start.py

Each is a new process; printed is the least of five times.
"""

import os
import resource
import subprocess
import sys

COMMAND = "import sys; sys.argv = {}; from romandask.cli.main import main; main()"
COMPLETION = {"_ROMANDASK_COMPLETE": "complete_bash", "COMP_WORDS": "romandask export f", "COMP_CWORD": "2"}
STARTS: tuple[tuple[str, str, dict[str, str]], ...] = (
    ("python", "pass", {}),
    ("import romandask", "import romandask", {}),
    ("romandask --version", COMMAND.format(["romandask", "--version"]), {}),
    ("romandask --help", COMMAND.format(["romandask", "--help"]), {}),
    ("romandask export --help", COMMAND.format(["romandask", "export", "--help"]), {}),
    ("completion of romandask export f", COMMAND.format(["romandask"]), COMPLETION),
    ("romandask.Survey", "import romandask; romandask.Survey", {}),
    ("romandask plan tiny", COMMAND.format(["romandask", "plan", "tiny"]), {}),
)
ATTEMPTS = 5


def cpu_time(code: str, environment: dict[str, str]) -> float:
    """Return the CPU time of a program, s."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", code], env=os.environ | environment, stdout=subprocess.DEVNULL, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    for name, code, environment in STARTS:
        print(f"{name:34s} {min(cpu_time(code, environment) for _ in range(ATTEMPTS)):6.2f} s")


if __name__ == "__main__":
    main()
