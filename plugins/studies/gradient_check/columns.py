"""The columns of the gradient check."""

from bench.experiment.columns import Column, Columns, ComparisonRule, numbers, text
from bench.gradient import VERDICTS

COLUMNS = Columns.of(
    Column("untrusted", "number of checks that show a gradient not to be trusted"),
    Column("best_error", "smallest relative error over all steps, of the worst check"),
    Column("best_eps", "step of that error, in units of the natural scale"),
    Column("scale", "natural scale of displacements of theta: its norm, at least 1"),
    Column("taylor_order", "order of the Taylor remainder along random directions: 2 for a right gradient, 1 if wrong"),
    Column("cost_noise", "measured standard deviation of the cost's own noise"),
    Column("jump", "largest jump of the cost that the noise reaches; 0 where none was found"),
    Column("jump_share", "that jump as a share of the range of the cost under the noise"),
    Column("jump_distance", "distance of that jump from theta, in standard deviations of the noise"),
    text(
        "verdict",
        "the worst verdict of the checks",
        comparison=ComparisonRule("verdict", "verdict", order=VERDICTS),
    ),
    text("command", "a line for the shell that repeats the checks"),
    text("device", "what the program ran on"),
    numbers("component", "components of theta that were checked one by one"),
    numbers("component_program", "of each component, the program's number"),
    numbers("component_difference", "of each component, what the differences settle on"),
    numbers("component_uncertainty", "of each component, the error of that"),
    numbers("component_step", "of each component, the step it was taken at, in units of the component"),
    numbers("component_ratio", "of each component, the program's number over the difference"),
    numbers("component_left", "of each component, the one-sided slope towards smaller values"),
    numbers("component_right", "of each component, the one-sided slope towards larger values"),
    numbers("component_verdict", "of each component, its verdict"),
    numbers(
        "point",
        "where each check was made: start, before, at or after a contact switch, or noise: at a jump that the noise reaches",
    ),
    numbers("sample", "of each check, 0 without noise, 1 with it"),
    numbers("direction", "of each check, the number of its direction; -1 - i for component i"),
    numbers(
        "contact_switch",
        "of each check at a contact switch, the contact and the first step that differ between its two sides",
    ),
    numbers("derivative_program", "of each check, the program's directional derivative"),
    numbers("check_verdict", "of each check, its verdict"),
    numbers("check_error", "of each check, the smallest relative error over all steps"),
    numbers("check_eps", "of each check, the step of that error"),
    numbers("eps", "the steps of the differences, in units of the scale"),
    numbers("derivative_differences", "of each check and step, the central difference"),
    numbers("relative_error", "of each check and step, its relative error"),
    numbers("mode_minus", "of each check and step, the contact mode on the minus side"),
    numbers("mode_plus", "of each check and step, the contact mode on the plus side"),
)
