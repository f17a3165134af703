"""Missions among beacons as a kind of mission: radio SLAM, a radio that is followed, ultrasonic motes."""

from ccatp.missions import MissionKind, Part

_STUDIES = "ccatp.beacons.studies"

BEACONS = MissionKind(
    systems=("zigbee", "follow", "cricket"),
    title="mission among beacons",
    no_resume="its map is not kept",
    no_faults="plans are for surveys; sim.incidents of the configuration holds those of beacons",
    load=Part("ccatp.beacons.config.load:load_beacon_mission"),
    text=Part("ccatp.beacons.daemon.beacon_run:beacon_text"),
    check=Part("ccatp.beacons.daemon.beacon_run:check_beacons"),
    without_effect=Part("ccatp.beacons.config.effects:keys_without_effect"),
    processes=Part("ccatp.beacons.daemon.beacon_run:PROCESSES"),
    record=Part("ccatp.beacons.records.summary:beacon_record"),
    runner=Part("ccatp.beacons.daemon.beacon_runner:open_beacons"),
    limits=Part("ccatp.beacons.daemon.beacon_runner:loop_limits"),
    rules=Part("ccatp.beacons.safety.rules:BeaconSafetyRules"),
    stand_in=Part("ccatp.beacons.dataloop:beacon_stand_in"),
    page=Part("ccatp.beacons.report.dashboard.view:beacon_page"),
    report=Part("ccatp.beacons.report.page:beacon_report"),
    analysis=Part("ccatp.beacons.analysis:open_beacons"),
    conditions="ccatp.beacons.conditions",
    waits={
        "mapping": "waits until the motes have measured each other, then drives to the first waypoint",
        "visiting": "stands for a moment before the move or until the danger loop permits it, then continues by itself",
        "following": "waits until the target moves away, then follows it",
    },
    stands=("mapping",),
    topics=Part("ccatp.beacons.links.topics:TOPICS"),
    commands=(Part("ccatp.beacons.cli.radio:radio"),),
    studies={
        "cricket": (f"{_STUDIES}.cricket_study:STUDY", "self-mapping of motes: the published figures, better ways"),
        "mote-sizes": (f"{_STUDIES}.cricket_study:run_sizes", "time of self-mapping against the number of motes"),
        "mote-navigation": (f"{_STUDIES}.mote_navigation:STUDY", "a robot guided by motes that mapped themselves"),
        "radio-signals": (
            f"{_STUDIES}.radio_studies:RADIO_SIGNALS",
            "levels and bearings of ZigBee radios, beside 2017",
        ),
        "radio-slam": (f"{_STUDIES}.radio_studies:RADIO_SLAM", "EKF-SLAM among ZigBee radios: rooms, slip, shadowing"),
        "radio-cases": (f"{_STUDIES}.radio_studies:RADIO_CASES", "cases I to III of 2017 side by side with ours"),
        "radio-follow": (f"{_STUDIES}.radio_studies:RADIO_FOLLOW", "a moving radio followed, beside 2018"),
        "recordings": (
            f"{_STUDIES}.recordings:RECORDINGS",
            "estimators on recorded runs among beacons, from several starts",
        ),
        "traits": (f"{_STUDIES}.traits:STUDY", "estimators on simulated runs with traits of real recordings"),
        "damage": (f"{_STUDIES}.damage:STUDY", "causal estimators on damaged recordings: recovered, reported or wrong"),
    },
    races=Part("ccatp.beacons.studies.bench_cases:races"),
)
