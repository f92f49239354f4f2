"""Finding other containers: dialling, announcing, listening, and asking again for what was missed."""
