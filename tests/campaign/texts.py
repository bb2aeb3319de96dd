"""Plans of sweeps and conditions of catalogues from anyone: a sentence, and nothing outside.

Runs aren't simulated here: what a plan may ask of the twin is the plan's cost, not a fault.
"""

import json
import random
import shutil

from .base import files_below
from .case import Result, front_door, run_forked
from .mutate import mutate_text
from .results import catalog_base, sweep_base

GRID = """scenario = "wave.toml"
seeds = 2
[analysis]
start_s = 0.5
[parameters."servo.stall_torque"]
values = [0.2, 0.3]
[parameters."robot.chain.joints"]
values = [3, 4]
"""
RANDOM = """scenario = "wave.toml"
duration_s = 2.0
design = "random"
points = 4
first_seed = 3
design_seed = 7
[parameters."servo.stall_torque"]
low = 0.2
high = 0.3
log = true
[parameters."gait.horizontal.frequency_hz"]
values = [1.0, 2.0]
"""
PLANS = [GRID, RANDOM, RANDOM.replace('"random"', '"sobol"')]
WORDS_OF_PLANS = [
    "1000000000", "[0.1, nan]", "[-inf, inf]", "1979-05-27", '"../../../tmp/x"', '"/etc/passwd"',
    '"\\u0000"', '"\\u001b[2J\\u001b]0;x\\u0007"', '"' + "x" * 1_000_000 + '"', "-0.5",
    '"' + "../" * 400 + '"', "{a = [{}]}", "[[[[[[]]]]]]", str([*range(30_000)]), '"key"',
]  # fmt: skip
MORE_OF_PLANS = [
    "".join(f"[parameters.x{k}]\nvalues = {list(range(1000))}\n" for k in range(4)),
    "".join(f"[parameters.x{k}]\nlow = 0\nhigh = 1\n" for k in range(25_000)),
    "".join(f"k{k} = 1\n" for k in range(50_000)),
    "[parameters." + "a." * 60_000 + "a]\nvalues = [1]\n",
    '[parameters.robot]\nvalues = ["snake25", "../../etc/passwd", ""]\n',
    '[parameters.key]\nvalues = ["../../x"]\n',
]

CONDITIONS = [
    "robot = 'snake25' and lag_sd > 0.05",
    "start > '2026-11-01' or path like '%.mcap'",
    "status = 'analysed' and duration_s between 1 and 1e9",
    "path in (select path from catalog where messages > 3)",
]
QUERIES = [
    "select robot, count(*) as sessions, avg(lag_sd) from catalog group by robot",
    "select path, list(joint) from joints group by path order by path",
]
WORDS_OF_QUERIES = [
    "; copy (select 1) to 'out.csv'", "; attach 'out.db'; --", "read_text('plan.toml')", "'",
    "read_csv('../*')", "range(1000000000)", "repeat('x', 2000000000)", "/*", "--", "((((", "))",
    "regexp_matches(repeat('a', 100000), '(a+)+$b')", "(" * 20_000, " not " * 20_000, "9" * 5000,
    "1e999", "generate_series(1, 1000000000)", "range(10000000) a, range(10000000) b", "cast(",
    "lpad('x', 2000000000, 'y')", "null", "[1, 2][", "{'a': 1}", "\0", "é", "\x1b[2J", "*", "x'00'",
    "(select content from read_blob('/etc/passwd'))", "pragma database_list", "union all",
    "; set memory_limit = '64GB'", "; install httpfs", "current_setting('home_directory')",
    "(with recursive t as (select 1 n union all select n + 1 from t) select max(n) from t)",
]  # fmt: skip


def run(seed, stage):
    """Mutate a plan or a condition and run its command."""
    rng = random.Random(seed)
    with stage.fresh() as folder:
        return (_run_plan if rng.random() < 0.6 else _run_condition)(rng, folder, stage)


def _with_word(text, words, rng):
    """Put a word in the place of another, or between two."""
    parts = text.split(" ")
    at = rng.randrange(len(parts))
    parts[at : at + rng.randrange(2)] = [rng.choice(words)]
    return " ".join(parts)


def _run_plan(rng, folder, stage):
    base = sweep_base(stage)
    for path in (base / "chain.toml", base / "wave.toml"):
        shutil.copy(path, folder)
    text = rng.choice(PLANS)
    kind = rng.random()
    if kind < 0.35:
        text = _with_word(text, WORDS_OF_PLANS, rng)
    elif kind < 0.5:
        text += rng.choice(MORE_OF_PLANS)
    if kind > 0.45:
        text = mutate_text(text.encode(), rng).decode("utf-8", "surrogateescape")
    (folder / "plan.toml").write_bytes(text.encode("utf-8", "surrogateescape"))
    words = ["sweep", "plan.toml", "-o", "out", *rng.choice([["--dry-run"], []])]
    return _judged(_without_runs(words), words, folder, ("w/out/",))


def _without_runs(words):
    """Return a function that runs a sweep's command with rows made up, of a few runs at most."""

    def work():
        from undulog.replay.sweep import sweep
        from undulog.replay.sweep.run import row_of

        def made_up(_setting, job):
            return {**row_of(job), "status": "done", "error": "", "run_wall": 0.1}

        def run_local(setting, jobs, *_):
            return (made_up(setting, job) for job in jobs[:20])

        sweep.run_job, sweep.run_local = made_up, run_local
        front_door(words)()

    return work


def _run_condition(rng, folder, stage):
    shutil.copytree(catalog_base(stage) / "lab", folder / "lab")
    option = rng.choice([["--where"], ["--joints", "--where"], ["--sql"]])
    text = rng.choice(QUERIES if option == ["--sql"] else CONDITIONS)
    for _ in range(rng.choice([1, 1, 2, 3])):
        if rng.random() < 0.7:
            text = _with_word(text, WORDS_OF_QUERIES, rng)
        else:
            text = mutate_text(text.encode(), rng).decode("utf-8", "replace")
    words = ["catalog", "lab", "--no-scan", *option, text, *rng.choice([["--json"], []])]
    return _judged(front_door(words), words, folder, ())


def _judged(work, words, folder, expected):
    """Run a command; judge it, and that it wrote nowhere but in some folders."""
    name = json.dumps(words)
    result = Result(name if len(name) < 300 else f"{name[:200]}... {len(name)} characters")
    before = {path: (folder.parent / path).read_bytes() for path in files_below(folder.parent)}
    outcome = run_forked(work, folder)
    result.add(outcome)
    for path in files_below(folder.parent):
        if path in before:
            if (folder.parent / path).read_bytes() != before[path]:
                result.failures.append(f"input: {path} was changed")
        elif not path.startswith(tuple(expected)) and path not in (f"{folder.name}.out", "w.err"):
            result.failures.append(f"stray: {path} was left")
    if len(outcome.err) > 200_000:
        result.failures.append(f"long: {len(outcome.err)} bytes on stderr")
    return result
