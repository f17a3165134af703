"""Rows of the table of conditions that a mission, its localizer, its link or the main loop finds."""

from ccatp.conditions import (
    ALONE,
    Action,
    Actor,
    Clear,
    Group,
    Owner,
    diverged,
    fault,
    go_home,
    hold,
    inform,
    pause,
    wait,
)

# fmt: off
BACK_OFFS = fault("back_offs", Owner.MISSION, ALONE, Group.EDGES,
    "at the edge again after {count} back-offs: is an edge sensor dirty?",
    "The way to the same point ends at an edge again and again.",
    "Clean the sensors, look at the place; `ccatp resume`, or abort.",
    then="clean the edge sensors, and look at the place")
STUCK_AT_EDGE = hold("stuck_at_edge", Owner.MISSION, ALONE, Group.EDGES,
    "stuck at the edge: no motion away from it is permitted, or none helps",
    "The edge sensors bar every direction.",
    "Look at the robot. It tries again by itself as soon as a sensor is back on.",
    action=Action.WAIT, clear=Clear.AUTO, actor=Actor.OPERATOR, then="look at the robot and its edge sensors")

NO_FRAME_FOR = wait("no_frame_for", Owner.MAIN, ALONE, Group.DATA, "no sensors frame for more than {limit_s:g} s",
    "The main loop receives no frames from the robot.", "Is the robot on, the network up?",
    then="switch the robot on, check the network")
NO_VERDICT = pause("no_verdict", Owner.MAIN, ALONE, Group.DATA, "no fresh verdict from the danger loop",
    "The danger loop is too slow, hangs, or is being restarted.",
    "Is something else busy on this machine? The supervisor restarts a danger loop that hangs.",
    then="end what else is busy on this machine")
FRAME_LATE = pause("frame_late", Owner.MAIN, ALONE, Group.DATA,
    "a frame was served {late_ms:.0f} ms late (limit {limit_ms:.0f} ms)",
    "This machine was too slow for one frame.",
    "Nothing, unless it repeats: other programs, or no real-time rights (`no real time` in `log.jsonl`).",
    then="end what else is busy on this machine")
FRAMES_OLD = pause("frames_old", Owner.MAIN, ALONE, Group.DATA,
    "frames are more than {limit_ms:.0f} ms old",
    "By the robot's echo of the drives, frames or drives are delayed by this time in the network or a queue.",
    "Check the network and the load of the robot's computer.", then="check the network")

UNATTENDED_FAULT = go_home("unattended_fault", Owner.MISSION, ALONE, Group.FANS,
    "unattended fault: at {charge:.0%} the battery lasts for little more than the way home",
    "Held on an overhanging mirror, and no operator has reacted: it goes home by itself, once.",
    "Attend to held robots; a fault is reported every minute.", then="attend to the fault before the next survey")
FANS_REFUSED = fault("fans_refused", Owner.MISSION, ALONE, Group.FANS, "fan command refused: {why}; set robot.fan_duty",
    "The robot would fall with the configured duty of its fans.", "Correct the configuration; start again.",
    then="correct robot.fan_duty, and start again")

LINK_LOST = wait("link_lost", Owner.LINK, ALONE, Group.LINK, "robot link lost: {reason}",
    "The connection ended. The robot holds its wheels by itself; main reconnects for `robot.reconnect_timeout_s`. "
    "A robot that rebooted, or may have moved meanwhile, is relocalized.",
    "Check network and robot. After `robot.reconnect_timeout_s` the run ends with status 5.",
    clear=Clear.AUTO, then="switch the robot on, check the network")
FRAMES_BACKWARD = diverged("frames_backward", Owner.LOCALIZER, ALONE, Group.LINK,
    "time stamps of the frames run backward",
    "Five in a row. The robot is held; repeated more than `health.retries` times, it is a fault.",
    "Check the clock of the firmware.", then="check the clock of the robot's firmware")
SENSOR_BACKWARD = diverged("sensor_backward", Owner.LOCALIZER, ALONE, Group.LINK,
    "time stamps of the {sensor} run backward",
    "The same for one sensor, likewise a fault if it repeats.", "Check the clock of the firmware.",
    then="check the clock of the robot's firmware")

LEG_OVERDUE = fault("leg_overdue", Owner.MISSION, ALONE, Group.SURVEY,
    "the leg to ({x_m:.3f}, {y_m:.3f}) m is overdue: is a wheel blocked or slipping?",
    "It takes many times longer than it should.", "Look at the robot.", then="look for an obstacle at the robot")
NO_REST = fault("no_rest", Owner.MISSION, ALONE, Group.SURVEY,
    "the robot does not come to rest: {v_m_s:.4f} m/s, {omega_rad_s:.4f} rad/s",
    "It should stand at a point, but moves.", "Shaking fans, or a slippery slope?", then="check fans and slope")
NO_WAY_ON = fault("no_way_on", Owner.MISSION, ALONE, Group.SURVEY, "no way on: {why}",
    "From where it stands no safe way leads to the next point.",
    "`ccatp abort`; if there is no way home either, carry it.",
    then="abort; if there is no way home, carry the robot to its base")
NO_WAY_HOME = fault("no_way_home", Owner.MISSION, ALONE, Group.SURVEY, "no way home: {why}",
    "From where it stands no safe way leads to base.", "Carry it to base.", then="carry the robot to its base")
TIME_USED_UP = go_home("time_used_up", Owner.MISSION, ALONE, Group.SURVEY,
    "the time budget of {budget_s:g} s is used up",
    "The way home would use the rest of it.", "Nothing; `ccatp run --resume` measures the remaining points.",
    then="measure the remaining points with 'ccatp run --resume'")
MEASUREMENTS_FAILED = fault("measurements_failed", Owner.MISSION, ALONE, Group.SURVEY,
    "{count} measurements in a row failed: {why}",
    "The laser system does not see the puck; the reason is after the colon.",
    "Check laser, line of sight and cleanliness of the puck; `ccatp resume`.",
    then="check the laser, its line of sight and the puck")
NOT_FOUND = fault("not_found", Owner.MISSION, ALONE, Group.SURVEY, "the robot cannot be found again: {why}",
    "Its pose is not trusted, and no fix determines its place.", "Check laser and line of sight; `ccatp resume`.",
    then="check the laser and its line of sight")
FRAME_REFUSED = fault("frame_refused", Owner.FIXES, ALONE, Group.SURVEY,
    "the laser system sees the robot {distance_m:.2f} m from {place}: {why}",
    "A fix at the start or on the way lies where the robot cannot be: the laser system has another frame.",
    "Check the configured collimators, base and start of the robot.",
    then="check the configured collimators, base and start")
LASER_NOT_READY = wait("laser_not_ready", Owner.FIXES, ALONE, Group.SURVEY,
    "the laser system is not ready (laserready_0)",
    "Its lasers are not warm. The robot waits at its point; no point is skipped.",
    "Wait, or look at the laser unit; `ccatp check` shows it as well.",
    then="wait for the lasers to be warm, or look at the laser unit")
LASER_NOT_FOLLOWING = fault("laser_not_following", Owner.FIXES, ALONE, Group.SURVEY,
    "the laser does not follow the robot: its fixes of {count} standstills agree, and encoders and gyroscope moved",
    "The lengths are those of one place (with noise) while wheels and gyroscope show motion: the laser measures "
    "another reflector or delivers old lengths. None of these fixes is used.",
    "Point the beams at the puck or restart the laser's driver; then `ccatp resume`: it takes a fix. `ccatp abort` "
    "sends the robot home by odometry.", then="point the beams at the puck, or restart the laser's driver")
METROLOGY_UNRELIABLE = inform("metrology_unreliable", Owner.FIXES, ALONE, Group.SURVEY,
    "the lengths of {count} points in a row contradict each other: channels {channels}",
    "The fixes navigate the robot, but are no measurement of the panels: these points are marked unreliable.",
    "Check the beams, the reflector and the air data of the laser system. Measure the points again.")
LENGTHS_REFUSED = fault("lengths_refused", Owner.FIXES, ALONE, Group.SURVEY,
    "the laser system's lengths do not lead to the robot's base: {why}",
    "The lengths of the first fix give no position.", "Check the configured collimators and base.",
    then="check the configured collimators and base")
FILTER_DIVERGED = diverged("filter_diverged", Owner.LOCALIZER, ALONE, Group.SURVEY, "filter: {why}",
    "The estimate is not a valid Gaussian any more. The pose is frozen until the next fix; a fault if it repeats.",
    "If it repeats, keep the run directory.", then="keep the run directory, and report the defect")

FIX_NOT_STORED = fault("fix_not_stored", Owner.FIXES, ALONE, Group.STORAGE,
    "the fix of {point} cannot be stored: {why}",
    "The disk is full or broken, or another program locks the database.",
    "Make room, or end that program; `ccatp resume` measures the point again. Once a write has failed nothing more is "
    "written: `ccatp stop`, then `ccatp run --resume`.", then="make room on the disk")
SKIP_NOT_STORED = fault("skip_not_stored", Owner.FIXES, ALONE, Group.STORAGE,
    "that {point} is skipped cannot be stored: {why}",
    "The disk is full or broken, or another program locks the database.",
    "Make room, or end that program; then `ccatp stop` and `ccatp run --resume`.", then="make room on the disk")
DISK_STALLS = fault("disk_stalls", Owner.FIXES, ALONE, Group.STORAGE,
    "the disk stalls: {point} is not stored after {time_s:g} s",
    "The disk does not answer.", "Check the disk; then `ccatp resume`.", then="check the disk")

RESTARTED = fault("restarted", Owner.OPERATOR, ALONE, Group.OBSERVATORY,
    "restarted: {done} points are measured and will be skipped, {left} are to do; 'ccatp resume' {goes_on}",
    "A run was started again and waits for an operator.", "`ccatp resume` continues it.", then="look at the robot")
OPERATOR = go_home("operator", Owner.OPERATOR, ALONE, Group.OBSERVATORY, "operator",
    "An operator called the robot home, or paused it: then it is held.",
    "`ccatp resume` after a pause; otherwise nothing: the run ends at the base.", action=Action.ABORT,
    actor=Actor.OPERATOR)
# fmt: on
