"""From a case to the patient's model: here alone the stages before a solve are strung together."""
