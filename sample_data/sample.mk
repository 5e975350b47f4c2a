# Judges the sample against its rendered truth. Your shot has none, and needs none of this.

all: $(WORK)/contact.png

$(WORK)/unwarped/$(DONE): $(WORK)/matte/$(DONE) $(WORK)/target_plates/$(DONE)
	$(RUN) composite $(WORK)/matte -o $(@D) --plates $(WORK)/target_plates $(FLAGS)

$(WORK)/contact.png: compare.py $(WORK)/composite/$(DONE) $(WORK)/unwarped/$(DONE)
	python compare.py $(WORK) --sheet $@
