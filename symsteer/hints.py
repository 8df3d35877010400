"""Words that users of other software type, and what they are called here."""

from __future__ import annotations

from collections.abc import Sequence

from symsteer.errors import UserError

_SAC = (
    "all learners here are soft actor-critic (SAC): 'standard' uses no symmetry, 'equivariant' "
    "keeps all of it; "
)
_OTHER_LEARNER = f"{_SAC}`symsteer new agent` begins one of your own; "
_DIFFUSION = "'plain' is a diffusion policy without symmetry, 'edp' is the equivariant one; "

_NAMES = {
    "agent": {
        "sac": _SAC,
        "dsrl dsrl-sac": f"{_SAC}`--agent standard --agent.preset dsrl` is DSRL as published; ",
        "dsrl-na": f"{_SAC}`--agent standard --agent.preset dsrl-na` is DSRL-NA as published; ",
        "ppo td3 ddpg dqn a2c trpo tqc rlpd crossq redq": _OTHER_LEARNER,
        "plain": "'standard' is the agent without symmetry; ",
        "strict equi-dsrl equidsrl": "'equivariant' is the agent that keeps all symmetry; ",
        "approximate": "'residual-pathway' is the approximately equivariant agent; ",
        "none random frozen edp gaussian": "'base' is the frozen policy alone; ",
    },
    "policy": {
        "dp diffusion diffusion-policy diffusion_policy ddpm ddim": _DIFFUSION,
        "equidiff equi-diffusion standard equivariant": _DIFFUSION,
    },
    "verb": {
        "train learn": "`symsteer run` trains one agent; ",
        "eval test play enjoy": "`symsteer evaluate RUN` plays a run's last checkpoint; ",
        "benchmark launch": "`symsteer sweep SUITE` executes many runs; ",
        "plot plots leaderboard results": "`symsteer report RUNS` writes tables and figures; ",
        "video render record": "`symsteer film RUN` films episodes; ",
        "continue": "`symsteer resume RUN` continues a run; ",
    },
}

_OPTIONS = {
    "--total-timesteps --total-steps --timesteps --n-timesteps --num-timesteps": (
        "the budget is --env-steps, control steps summed over the parallel environments"
    ),
    "--env-id --env --env-name": "name the task with --task",
    "--n-envs --num-environments": "use --num-envs",
    "--algo --alg --algorithm": "name the agent with --agent",
    "--policy --policy-name": "name the base policy with --policy.name",
    "--preset": "use --agent.preset",
    "--learning-rate --lr --policy-lr --q-lr --actor-lr --critic-lr": (
        "use --agent.lr for the agent, or --policy.learning-rate for the base policy"
    ),
    "--gamma --discount": "use --agent.gamma, the discount per decision",
    "--tau": "use --agent.tau",
    "--batch-size": "use --agent.batch-size, or --policy.batch-size for the base policy",
    "--buffer-size --replay-size": "use --agent.replay-capacity, in decisions",
    "--learning-starts": "use --agent.warmup, in decisions",
    "--utd --utd-ratio --gradient-steps": "use --agent.utd, updates per decision",
    "--alpha --ent-coef": "use --agent.initial-alpha; alpha is then tuned",
    "--critic --agent.critic --n-critics --num-critics": (
        "use --agent.critics for their number, and --agent.critic-kind for what they judge"
    ),
    "--eval-freq --eval-every": "use --evaluation.every, in control steps",
    "--n-eval-episodes --eval-episodes --num-eval-episodes": "use --evaluation.episodes",
    "--cuda --gpu": "use --device cuda",
    "--sim-backend": "use --sim cpu or --sim cuda",
    "--robot --robot-uids": "use --embodiment floating or --embodiment panda",
    "--control-mode --obs-mode --reward-mode": "the task and its embodiment decide this",
    "--n-seeds --seeds": "give one --seed, or list seeds in a suite for `symsteer sweep`",
    "--logdir --log-dir --output-dir --save-dir --exp-dir": "name the folder with --runs",
    "--exp-name --run-name": "a run is named after its configuration; choose a folder with --runs",
    "--wandb --use-wandb": "use --track",
    "--wandb-project --wandb-project-name": "use --track and set WANDB_PROJECT",
    "--wandb-entity --wandb-group": "use --track and set W&B's environment variables",
    "--capture-video --save-video --record-video": "`symsteer film RUN` films a finished run",
    "--save-model --save-freq": "every run keeps its last checkpoint; see --checkpoint-every",
    "--resume --load --checkpoint": "`symsteer resume RUN` continues a run",
}
"""Options of no verb, several in one key."""

_ELSEWHERE = {
    "--out": ("run sweep tune demo", "name the folder of runs with --runs"),
    "--workers": (
        "run resume evaluate reproduce",
        "use --sim-workers for the processes that share a simulation; --workers is for sweeps",
    ),
}
"""Options that some verbs have, and those that have another one."""


def name_hint(kind: str, name: str) -> str:
    """What a name of other software is here, to put into a message; empty if that is unknown."""
    table = _NAMES.get(kind, {})
    return next((hint for words, hint in table.items() if name.lower() in words.split()), "")


def check_options(verb: str, arguments: Sequence[str]) -> None:
    """Refuse the options of other software.

    Raises:
        UserError: naming the option to use.
    """
    for argument in arguments:
        option = argument.partition("=")[0].replace("_", "-")
        if option.startswith("--") and (hint := _option_hint(verb, option)):
            raise UserError(f"symsteer {verb} has no option {option}; {hint}")


def _option_hint(verb: str, option: str) -> str:
    verbs, elsewhere = _ELSEWHERE.get(option, ("", ""))
    if verb in verbs.split():
        return elsewhere
    return next((hint for words, hint in _OPTIONS.items() if option in words.split()), "")
