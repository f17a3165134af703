"""What slows, holds or stops a robot among beacons, besides the conditions of every mission: rows of that table."""

from functools import partial

from ccatp.conditions import (
    ALONE,
    Action,
    Clear,
    Condition,
    Motion,
    Owner,
    fault,
    near,
    registered,
)

GROUP = "Among beacons"

hold = registered(
    partial(
        Condition,
        action=Action.HOLD,
        motion=Motion.NONE,
        clear=Clear.AUTO,
        limit="danger.hold_limit_s",
        escalates_to=Action.FAULT,
    )
)
# fmt: off
RADIO_SILENT = hold("radio_silent", Owner.DANGER, 580, GROUP, "no beacon is received",
    "No reading of a beacon for `danger.radio_timeout_s`.", "Check the robot's radio and the beacons' supply.",
    unit="s", then="check the robot's radio and the beacons' supply")
NO_FRESH_ESTIMATE = hold("no_fresh_estimate", Owner.DANGER, 590, GROUP, "no fresh estimate",
    "Main has not reported where the robot is for `danger.estimate_timeout_s`.",
    "Is something else busy on this machine?", unit="s", then="end what else is busy on this machine")
POSITION_UNCERTAIN = hold("position_uncertain", Owner.DANGER, 600, GROUP,
    "the position is too uncertain",
    "Its standard deviation is above `danger.position_sigma_m`. It ends below `danger.position_clear_m`.",
    "Nothing, unless it lasts: beacons may fail.", unit="m", then="check the beacons")
OBSTACLE_AHEAD = near("obstacle_ahead", Owner.DANGER, 610, GROUP, "an obstacle ahead",
    "An echo is nearer than `danger.obstacle_m` on the course. Code 1.", "Nothing: the robot drives around it.")
TARGET_NEAR = near("target_near", Owner.DANGER, 620, GROUP, "the target is too near",
    "By its level, the followed radio is nearer than `danger.target_m`. Code 1.",
    "Nothing: the robot backs off, if it can.")
OBSTACLE_BEHIND = near("obstacle_behind", Owner.DANGER, 630, GROUP, "an obstacle behind",
    "An echo is nearer than `danger.obstacle_m` behind the robot: no reverse. Code 1.", "Nothing.")
FRAMES_MISSED = fault("frames_missed", Owner.MISSION, ALONE, GROUP,
    "no frames while the robot moved: put it at its start and start a new mission",
    "The robot booted, or the link was away while it may have moved; the map of the beacons is not kept.",
    "`ccatp stop`, put it at its start, start again.", then="put the robot at its start, and start a new mission")
MISSION_TOO_LONG = fault("mission_too_long", Owner.MISSION, ALONE, GROUP,
    "the mission takes longer than mission.time_limit_s = {limit_s:g}",
    "The robot is held where it is.", "`ccatp abort` sends it home; or configure a longer time.",
    then="abort, or configure a longer time")
TARGET_LOST = fault("target_lost", Owner.MISSION, ALONE, GROUP,
    "the followed radio {name} was not received for {lost_s:g} s",
    "The robot stands without it. Only time in which it is received counts as followed. The limit is "
    "`follow.lost_after_s` and `danger.hold_limit_s` together.",
    "Check its supply and its name (`follow.target`); `ccatp resume` waits for it again.",
    then="check the supply and the name of the radio")
MAP_STALLED = fault("map_stalled", Owner.MISSION, ALONE, GROUP,
    "the motes do not map themselves: {lacking}, and no further one for {stalled_s:g} s",
    "No range arrives that the map of the motes could use. The robot stands until there is a map. The limit is "
    "`danger.hold_limit_s`.", "Check the named motes: their supply, their names, and what is between them.",
    then="check the named motes")
READINGS_REFUSED = fault("readings_refused", Owner.MISSION, ALONE, GROUP,
    "{refused:g} of the last {count:g} readings contradict the estimated place: it is wrong, or the map",
    "The robot was moved, its wheels slipped, samples came late, or beacons stand elsewhere.",
    "`ccatp stop`, put it at its start, start again; if it repeats, check wheels, beacons and computer.",
    then="put the robot at its start, and start a new mission")
# fmt: on
