"""Configurations of agents: validated YAML files that say what to train, on what, and for how long."""

from agents.configuration.algorithms import PPO, SAC, TD3, TQC, Algorithm, Demonstrated, Hindsight, OffPolicy
from agents.configuration.imitation import ActionChunking, Cloning, Dagger, ImitationConfiguration
from agents.configuration.loading import ConfigurationError, list_configurations, load_configuration
from agents.configuration.reinforcement import ActionScale, Configuration, Practice, Schedule
from agents.configuration.schema import AgentConfiguration, DemonstrationSource, Network

__all__ = [
    "PPO",
    "SAC",
    "TD3",
    "TQC",
    "ActionChunking",
    "ActionScale",
    "AgentConfiguration",
    "Algorithm",
    "Cloning",
    "Configuration",
    "ConfigurationError",
    "Dagger",
    "Demonstrated",
    "DemonstrationSource",
    "Hindsight",
    "ImitationConfiguration",
    "Network",
    "OffPolicy",
    "Practice",
    "Schedule",
    "list_configurations",
    "load_configuration",
]
