"""The version of sasmap."""

VERSION = "0.1.0"
