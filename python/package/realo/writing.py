"""The writer of logs, which is the module `realo_log`: it needs numpy alone and works without this package."""

from realo_log import LogWriter, agent, view

__all__ = ["LogWriter", "agent", "view"]
