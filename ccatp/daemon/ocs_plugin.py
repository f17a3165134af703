"""What the observatory control system finds under the entry point ``ocs.plugins``: our agent."""

package_name = "ccatp"
agents = {"CcatpAgent": {"module": "ccatp.daemon.ocs_agent", "entry_point": "main"}}
