"""Every number that decides a name, with its kind, its unit and its reason."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from typing import Any, Literal, get_args

Kind = Literal["law", "convention", "study", "cost"]
KINDS: tuple[Kind, ...] = get_args(Kind)


def declare_number(
    default: Any, *, law: str = "", convention: str = "", study: str = "", cost: str = "",
    unit: str = "", source: str = "",
) -> Any:  # fmt: skip
    """Declare a number with its reason, in the sentence of its kind.

    Parameters
    ----------
    default : number or tuple of numbers
        The value.
    law, convention, study, cost : str
        Exactly one of them has the reason: the number follows from a law of statistics or
        physics; it is a convention that another toolbox could replace; it was chosen by judgement
        and its effect on the names is to be measured by the study; or it bounds time, memory or
        rounding and is to change no name.
    unit : str, optional
        What it counts.
    source : str, optional
        Where the number comes from.
    """
    reasons = {"law": law, "convention": convention, "study": study, "cost": cost}
    given = [k for k, reason in reasons.items() if reason]
    if len(given) != 1:
        raise ValueError(
            f"a number needs exactly one reason, given {' and '.join(given) or 'none'}"
        )
    kind = given[0]
    about = {"kind": kind, "reason": reasons[kind], "unit": unit, "source": source}
    return field(default=default, metadata=about)


@dataclass(frozen=True)
class Threshold:
    """One number of the table: its name, value, kind, reason, unit and source."""

    name: str
    value: Any
    kind: Kind
    reason: str
    unit: str
    source: str


@dataclass(frozen=True)
class Thresholds:
    """The numbers of the diagnosis, in the order of its steps.

    A gain of log-likelihood counts in natural units. "Best" is the candidate with the largest net
    gain, which is the gain of a refit less half the penalty of the Bayesian information criterion.
    """

    # Step 1: records looked over.
    repeats: int = declare_number(
        3, convention="an experiment that repeats itself so often gives its noise without a model",
        unit="periods",
    )  # fmt: skip
    clipped: float = declare_number(
        0.005, study="samples exactly on a limit are worth a name from here on",
        unit="of the samples",
    )  # fmt: skip
    coarse_steps: float = declare_number(
        0.25, study="steps of the converter that make so much of the noise are worth a remark and "
        "join the loop, in which equal readings in a row count once",
        unit="of the sensor noise's variance",
    )  # fmt: skip
    noise_beside_steps: float = declare_number(
        1e-3, cost="so much of the noise at least is left beside the steps of a converter",
        unit="of the sensor noise's variance",
    )  # fmt: skip
    rounding: float = declare_number(
        1e-9, cost="values that differ by less are the same: a sample and a limit of the sensor, "
        "two periods, an edge and zero, a start and its bound", unit="of the value or its range",
    )  # fmt: skip
    tiny: float = declare_number(
        1e-300,
        cost="keeps logarithms and quotients of zero finite; smaller probabilities cannot "
        "be told from zero in double precision",
    )

    # Step 2: recalibration.
    parameter_range: float = declare_number(
        10.0, convention="a model whose parameter is further off is another model",
        unit="times the given value, or its inverse",
    )  # fmt: skip
    exact_readings: float = declare_number(
        1e4, study="where one-step errors are so much larger than the sensor's noise, the random "
        "force stands for what is missing, and the model is also fitted from a usual noise",
        unit="times its variance",
    )  # fmt: skip
    far_recalibration: float = declare_number(
        0.3, study="a recalibration that moved further is doubted, and candidates are also tried "
        "at the given values", unit="of the given value",
    )  # fmt: skip
    fitted_samples: int = declare_number(
        40_000, cost="longer records are fitted on even stretches of them", unit="samples"
    )
    stretches: int = declare_number(12, cost="of a long record", unit="stretches")
    shortest_stretch: int = declare_number(1000, cost="of a long record, at least", unit="samples")

    # Step 3: is it noise, and where not.
    false_alarm: float = declare_number(
        2e-3, convention="chance that all tests together raise a false alarm, for each effect in "
        "the model and once without any", unit="probability",
    )  # fmt: skip
    false_alarm_beside_kinks: float = declare_number(
        1e-4, study="the same where the model has kinks such as dry friction, which the filter "
        "follows only nearly", unit="probability",
    )  # fmt: skip
    beyond_replica: float = declare_number(
        3.0, study="a test that fails on replicas of the model speaks against the model only if it "
        "fails by so many times the logarithm of chance",
    )  # fmt: skip
    lags: int = declare_number(
        25, convention="as usual in residual analysis", unit="samples",
        source="Ljung, System Identification, section 16.6",
    )  # fmt: skip
    past_lags: tuple[int, ...] = declare_number(
        (1, 2, 3, 4, 6, 9, 14), convention="past changes of input and reference on which "
        "innovations are regressed, denser where plants answer", unit="samples",
    )  # fmt: skip
    past_left_out: int = declare_number(
        20, cost="samples at the beginning, whose past is not whole", unit="samples"
    )
    past_rank: float = declare_number(
        1e-6, cost="a column that others explain to so much says nothing of its own",
        unit="of the largest",
    )  # fmt: skip
    force_settling: float = declare_number(
        0.05, study="so much at the beginning the estimate of a force is still being found",
        unit="of the record",
    )  # fmt: skip
    independent_force: int = declare_number(
        40, law="below, the transformations of skewness and kurtosis do not hold",
        unit="independent samples", source="Anscombe and Glynn, Biometrika 70 (1983)",
    )  # fmt: skip
    bins: int = declare_number(12, convention="equally filled bins along a quantity", unit="bins")
    fewest_in_bin: int = declare_number(
        40, law="the mean of so many samples is Gaussian enough for a chi-squared test",
        unit="samples",
    )  # fmt: skip
    slow_rhythm: float = declare_number(
        0.05, study="up to there a periodic change of a parameter is looked for",
        unit="of Nyquist's frequency",
    )  # fmt: skip
    telling: float = declare_number(
        1e-3, convention="a place is told to the user, or that a parameter has different values in "
        "several records, if noise alone looks like it less often", unit="probability",
    )  # fmt: skip
    surely_left: float = declare_number(
        1e-4, convention="the verdict's sentence says where something remains if noise alone "
        "looks like it less often", unit="probability",
    )  # fmt: skip

    # Step 4: screening.
    usual_speed: float = declare_number(
        0.99, convention="the largest usual speed is this quantile", unit="of the samples"
    )
    seen: float = declare_number(
        1e-7, cost="a parameter of which others leave less is not told from them in double "
        "precision", unit="of its information",
    )  # fmt: skip
    fainter_tries: int = declare_number(
        3, cost="how often an effect that promises nothing is tried at a tenth of its size",
        unit="times",
    )  # fmt: skip
    fainter: float = declare_number(
        0.1, cost="by that an effect is made fainter", unit="of its size"
    )
    scan_block: int = declare_number(500_000, cost="shapes are scanned in blocks", unit="numbers")

    # Step 5: refit.
    refit_rounds: int = declare_number(
        14, cost="a candidate that needs more is not the missing effect", unit="steps of the climb"
    )
    refitted_first: int = declare_number(
        5, cost="so many are refitted because of their score", unit="candidates"
    )
    refitted_share: float = declare_number(
        0.2, cost="a candidate whose score is larger is refitted as well",
        unit="of the largest score",
    )  # fmt: skip
    faint: float = declare_number(
        0.5, cost="a candidate whose score is smaller is not refitted",
        unit="of the score that would earn a place",
    )  # fmt: skip
    significant: float = declare_number(
        2.0, law="a fitted effect that is smaller may as well be absent", unit="standard errors"
    )
    near_winner: float = declare_number(
        0.5, study="a candidate that comes so close is climbed on under the winner's noise",
        unit="of the best net gain",
    )  # fmt: skip
    different_force: float = declare_number(
        2.0, study="random forces whose time constants differ by more are two forces", unit="times"
    )
    instant_doublings: int = declare_number(
        11, cost="an instant is moved by 1, 2, 4, ... samples, so many times", unit="doublings"
    )
    instant_rounds: int = declare_number(4, cost="of the climb from a better instant",
                                unit="steps of the climb")  # fmt: skip

    # Step 6: decide.
    power: float = declare_number(
        0.8, convention="sizes that a record would have shown are those that so many records like "
        "it show; as usual in planning experiments", unit="of the records",
    )  # fmt: skip
    gate: float = declare_number(
        5.0, law="a difference of 10 of the Bayesian information criterion is very strong",
        unit="of net gain", source="Kass and Raftery 1995",
    )  # fmt: skip
    looked_at: int = declare_number(5, cost="so many after the best are looked at closely",
                           unit="candidates")  # fmt: skip
    no_artefact: float = declare_number(
        400.0, study="the filter's approximations do not gain so much for a first effect, so no "
        "replica is asked", unit="of log-likelihood",
    )  # fmt: skip
    replica_weight: float = declare_number(
        2.0, study="what an effect gains on replicas without it counts so much against it",
        unit="times",
    )  # fmt: skip
    slight_beside_kink: float = declare_number(
        30.0, study="beside a kink, a smaller net gain is compared with more replicas",
        unit="of log-likelihood",
    )  # fmt: skip
    replicas_beside_kink: int = declare_number(4, cost="so many of those replicas", unit="replicas")
    replica_sharpness: float = declare_number(
        16.0, study="friction in a replica is as abrupt as with a period so many times shorter; "
        "four times as sharp, and what mends a filter's friction gains 4 % more", unit="times",
    )  # fmt: skip
    replica_steps: int = declare_number(64, cost="sharp friction would ask for more",
                               unit="steps of the integration in a period")  # fmt: skip
    replica_rounds: int = declare_number(8, cost="of a model fitted to its replica",
                                unit="steps of the climb")  # fmt: skip
    shortest_segment: int = declare_number(
        10, cost="shorter ones are not simulated anew", unit="samples"
    )
    law_order: int = declare_number(
        3, cost="of the regression that finds how the recorded input reacts to y", unit="samples"
    )
    law_left: float = declare_number(
        1e-3, cost="a law that leaves more of the recorded input is not the controller's, which "
        "computes it from recorded numbers up to their rounding",
        unit="of the variance of the input's change in a sample",
    )  # fmt: skip
    simpler_nearly: float = declare_number(
        0.1, study="a simpler effect takes the place of a richer one only if it loses less",
        unit="of the richer one's gain",
    )  # fmt: skip
    hint: float = declare_number(
        1.0, law="a larger model gains so much by chance in about one record of six",
        unit="of log-likelihood", source="chi-squared distribution, one degree of freedom",
    )  # fmt: skip

    # Step 7: add, drop, look back.
    many_effects: int = declare_number(
        4, study="so many effects describe almost any error, and explain none", unit="effects"
    )
    some_effects: int = declare_number(
        3, study="of so many effects none may be slight", unit="effects"
    )
    more_rounds: int = declare_number(
        2, cost="the search ends after so many rounds more than effects may be found",
        unit="rounds",
    )  # fmt: skip
    slight_effect: float = declare_number(
        0.02, study="what corrects so little beside others may correct their wrong law",
        unit="of the largest gain",
    )  # fmt: skip
    residue: float = declare_number(
        0.1, study="two look-alikes that both add less to each other may be one thing; in 1 011 "
        "runs the rule spoke in four, all of them limited rates", unit="of what all explain",
    )  # fmt: skip
    looked_back: int = declare_number(
        3, cost="so many choices that a round did not take are asked what could follow on them",
        unit="candidates",
    )  # fmt: skip
    tried_quietly: int = declare_number(
        6, cost="so many are refitted under hardly any random force, those of the best scores",
        unit="candidates",
    )  # fmt: skip
    released: int = declare_number(
        2, cost="so many of those are refitted with the random force free", unit="candidates"
    )
    minor: float = declare_number(
        0.15, study="an effect that gains less, beside something unknown, is a stand-in unless it "
        "helps on fresh data; a search that was stopped did not ask that", unit="of the whole gain",
    )  # fmt: skip
    small_gain: float = declare_number(
        0.6, study="an effect beside others that gains less is a stand-in",
        unit="of what the tests say is missing",
    )  # fmt: skip
    little_of_known: float = declare_number(
        0.1, study="an effect that gains less is a stand-in", unit="of what known noise leaves open"
    )
    regained: float = declare_number(
        0.05, cost="one effect that promises less than this does not stand for two; friction that "
        "sticks promises little beside the force that stood for it",
        unit="of what leaving one of them out loses",
    )  # fmt: skip
    colour_promise: float = declare_number(
        2.0, cost="coloured sensor noise is looked for only where so much could beat the best "
        "effect: in none of the records looked at did a colour gain more",
        unit="of what an autoregression of the innovations gains",
    )  # fmt: skip
    search_samples: float = declare_number(
        3e8, cost="work after which a search without seconds= ends unfinished: some minutes",
        unit="filtered samples, and 2000 more for each pass",
    )  # fmt: skip
    surely_needed: float = declare_number(
        100.0, cost="an effect so significant is not asked whether it is needed",
        unit="times the gate",
    )  # fmt: skip
    removal_rounds: int = declare_number(
        10, cost="of a model from which an effect is taken, or whose order is changed",
        unit="steps of the climb",
    )  # fmt: skip
    log_error_samples: int = declare_number(
        1000, cost="on which repairs of the log are tried at the given values", unit="samples"
    )

    # Step 8: what else would do, and which experiment tells.
    close: float = declare_number(
        3.0, convention="likelihoods that differ by less say nothing", unit="of log-likelihood",
        source="Kass and Raftery 1995: a factor of 20",
    )  # fmt: skip
    same_predictions: float = declare_number(
        4.0, study="two models whose likelihood ratio scatters less predict the same: one contains "
        "the other", unit="of log-likelihood, standard deviation",
    )  # fmt: skip
    vuong_z: float = declare_number(
        2.0, convention="as usual, 5 %", unit="standard deviations",
        source="Vuong, Econometrica 57 (1989)",
    )  # fmt: skip
    block: int = declare_number(
        50, study="terms are summed over so many samples before their spread is taken, so that "
        "neighbours may be correlated", unit="samples",
    )  # fmt: skip
    doubtful_rival: float = declare_number(
        0.6, study="where something is left, a look-alike with more is not excluded",
        unit="of the best net gain",
    )  # fmt: skip
    small_part: float = declare_number(
        0.2, study="a further parameter that is surely smaller makes no other effect",
        unit="of the size of the effect",
    )  # fmt: skip
    taken_by_better: float = declare_number(
        1.0, study="another effect takes the place of one that was found if it gains so much more",
        unit="of log-likelihood",
    )  # fmt: skip
    rival_rounds: int = declare_number(4, cost="of a model in which a rival took an effect's place",
                              unit="steps of the climb")  # fmt: skip
    least_spread: float = declare_number(
        1e-12, cost="keeps Vuong's statistic finite where two models predict the same",
        unit="of log-likelihood",
    )  # fmt: skip
    tie: float = declare_number(
        0.02, cost="gains that differ by less are those of one and the same effect on every record",
        unit="of log-likelihood",
    )  # fmt: skip
    experiment_samples: int = declare_number(20_000, cost="of a recommended experiment, at most",
                                    unit="samples")  # fmt: skip
    experiment_shortest: int = declare_number(5000, cost="of a recommended experiment, at least",
                                     unit="samples")  # fmt: skip
    experiment_tried: int = declare_number(
        2000, cost="on which references are compared", unit="samples"
    )
    experiment_levels: tuple[float, ...] = declare_number(
        (-1.0, 1.0, -0.5, 0.5, 0.0), convention="set-points that a reference visits",
        unit="of its reach",
    )  # fmt: skip
    experiment_times: int = declare_number(
        4, convention="how much larger, faster or slower a bolder reference is", unit="times"
    )
    experiment_smallest: float = declare_number(
        0.1, convention="the jumps of a reference are at least so large", unit="of its reach"
    )
    experiment_step: float = declare_number(
        1e-3, convention="its jumps where the record's reference never moved", unit="of y"
    )
    experiment_bolder: float = declare_number(
        1.2, convention="a bolder experiment is chosen if it tells so much more", unit="times"
    )
    experiment_ramp: float = declare_number(0.1, convention="spent on the way to a set-point",
                                   unit="of its duration")  # fmt: skip
    experiment_worth: float = declare_number(
        1.5, study="an experiment that tells less is not worth the name",
        unit="times the distance of the record itself",
    )  # fmt: skip
    experiment_gain: float = declare_number(
        1000.0, study="where an experiment tells so much more, the record itself says nothing",
        unit="times the distance of the record itself",
    )  # fmt: skip
    experiment_distance: float = declare_number(
        60.0, law="Vuong's statistic is near four there, on average", unit="squared, in noise"
    )
    experiment_margin: float = declare_number(
        1.2, convention="the loop must survive the reference so much larger", unit="times"
    )
    experiment_reach: float = declare_number(
        3.0, convention="an output that goes further is lost",
        unit="times the range of reference or record",
    )  # fmt: skip

    # Step 9: gap and floor on fresh data.
    held_out: float = declare_number(0.25, convention="kept back for the comparison",
                            unit="of the valid samples")  # fmt: skip
    held_out_samples: int = declare_number(30_000, cost="of those, at most", unit="samples")
    lead: int = declare_number(
        5, convention="one in so many of the samples kept back are added before them, in which the "
        "start may still show", unit="samples",
    )  # fmt: skip
    shortest_lead: int = declare_number(200, convention="the same, at least", unit="samples")
    start_left_out: float = declare_number(
        0.02, convention="the guess of the initial state may still show there",
        unit="of a validation record",
    )  # fmt: skip
    gap_integration_error: float = declare_number(
        1e-5, cost="far below any gap worth a word", unit="local error, relative"
    )
    gap_steps: int = declare_number(8, cost="sharp friction would ask for many more",
                           unit="steps of the integration in a period")  # fmt: skip
    floor_runs: int = declare_number(3, cost="simulations with noise for the floor", unit="runs")
    floor_more_runs: int = declare_number(
        8, cost="the same where a gap stands out: loops that hunt differ from run to run",
        unit="runs",
    )  # fmt: skip
    mean_runs: int = declare_number(
        8, cost="pairs of simulations with noise and its opposite, whose mean is compared: with 4 "
        "times as many a gap changes by 2 % at most", unit="pairs",
    )  # fmt: skip
    size_runs: int = declare_number(
        32, cost="simulations whose spread tells an error that is too small for the noise: of the "
        "first 8 seeds it is half as wide as of many", unit="runs",
    )  # fmt: skip
    beyond_chance: float = declare_number(
        0.01, convention="level of every test that decides alone: whether errors of two models "
        "differ, whether noise is larger than the gap, whether a name stands", unit="probability",
    )  # fmt: skip
    independent_block: float = declare_number(
        4.0, law="means of so long blocks hardly correlate, so that Student's test of them keeps "
        "its level: 1.0 to 1.3 % at 1 %, for memories of 1 to 100 samples in 500 to 2000",
        unit="autocorrelation times",
    )  # fmt: skip
    phase_starts: int = declare_number(4, cost="phases from which that of a record is looked for",
                              unit="phases")  # fmt: skip
    helps: float = declare_number(
        0.05, study="an effect that closes less of what is left without it does not help",
        unit="of the gap above the floor, squared",
    )  # fmt: skip

    # Step 10: the decision table.
    excess: float = declare_number(
        1.5, study="a gap that is wider is not explained by noise; twice that beside a coloured "
        "force", unit="times what noise leaves",
    )  # fmt: skip
    large_disturbance: float = declare_number(
        0.5, convention="a random force that makes more may hide something",
        unit="of the floor's variance",
    )  # fmt: skip
    worse_than_given: float = declare_number(
        1.2, study="with a large random force, a fit whose gap is wider explains nothing",
        unit="times the gap of the model as given",
    )  # fmt: skip
    near_floor: float = declare_number(
        1.2, convention="a gap that noise explains", unit="times the floor"
    )
    widened: float = declare_number(
        1.05, convention="a recalibration whose gap is wider is explained to the user",
        unit="times the gap as given",
    )  # fmt: skip
    strong: float = declare_number(10.0, convention="evidence that is called strong",
                          unit="of log-likelihood")  # fmt: skip
    certain: float = declare_number(30.0, convention="evidence that is called very strong",
                           unit="of log-likelihood")  # fmt: skip

    # Names that stand.
    stretches_compared: int = declare_number(
        4, convention="sizes are compared between quarters, as long as what is kept back",
        unit="of each record",
    )  # fmt: skip

    tapers: int = declare_number(
        5, convention="so many windows tell a line of the reference from power about it; they see "
        "as far as three times what a record resolves", unit="windows",
        source="Thomson, Proc. IEEE 70 (1982) 1055",
    )  # fmt: skip
    same_size: float = declare_number(
        0.05, convention="quarters whose sizes differ by less have one size for who uses the model",
        unit="of the size",
    )  # fmt: skip

    # Stable plants, by the error of an open-loop simulation.
    open_loop_samples: int = declare_number(12_000, cost="longer records are not searched so",
                                   unit="samples")  # fmt: skip
    open_loop_rounds: int = declare_number(5, cost="of the search", unit="rounds")
    open_loop_refitted: int = declare_number(8, cost="of a round", unit="candidates")
    open_loop_evaluations: int = declare_number(60, cost="of a refit", unit="simulations")
    open_loop_rank: float = declare_number(
        1e-10, cost="directions in which the error changes less are left out",
        unit="of the largest singular value",
    )  # fmt: skip
    line_padding: int = declare_number(
        4, cost="zeros that make the spectrum finer", unit="times the record"
    )
    slowest_line: int = declare_number(
        8, convention="a slower line of the padded spectrum is a drift, not a vibration",
        unit="bins of the padded spectrum",
    )  # fmt: skip
    open_loop_closes: float = declare_number(
        0.95, study="an effect stays if no more is left", unit="of the error before it"
    )
    open_loop_alike: float = declare_number(
        0.2, study="a candidate that comes nearer is not told from the effect",
        unit="of the effect's net gain",
    )  # fmt: skip
    open_loop_better: float = declare_number(
        0.8, study="the search counts if no more is left", unit="of the gap of the search by filter"
    )
    lost_simulation: float = declare_number(
        1e3, cost="the error of a sample at which a simulation has left the plant's domain",
        unit="times the output's spread",
    )  # fmt: skip

    def table(self) -> tuple[Threshold, ...]:
        """Return name, value and reason of every number, in order."""
        return tuple(Threshold(f.name, getattr(self, f.name), **f.metadata) for f in fields(self))


THRESHOLD = Thresholds()


@contextmanager
def vary_numbers(**values: Any) -> Iterator[None]:
    """Let numbers of the table have other values within a ``with`` block, for studies of them.

    They are those of this process: candidates tried in processes of their own keep the table.

    Parameters
    ----------
    **values
        Numbers by their names.

    Raises
    ------
    AttributeError
        If the table has no such number.
    """
    known = {name: getattr(THRESHOLD, name) for name in values}
    try:
        for name, number in values.items():
            object.__setattr__(THRESHOLD, name, number)
        yield
    finally:
        for name, number in known.items():
            object.__setattr__(THRESHOLD, name, number)
