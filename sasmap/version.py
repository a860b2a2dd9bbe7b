"""The version of sasmap."""

VERSION = "0.2.0"
