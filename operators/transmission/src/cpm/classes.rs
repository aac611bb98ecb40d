//! Classes of objects: the names that detectors and logs give, and `ObjectClass`.

use c_its_parser::standards::cdd_2_2_1::etsi_its_cdd::{
    ObjectClass, OtherSubClass, TrafficParticipantType, VruProfileAndSubprofile, VruSubProfileAnimal,
    VruSubProfileBicyclist, VruSubProfileMotorcyclist, VruSubProfilePedestrian,
};

/// What stands for a class that has no other name.
pub(crate) const UNKNOWN: &str = "unknown";

/// A class as a number of `TrafficParticipantType`, or a profile of vulnerable road users and a number of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Code {
    Vehicle(u8),
    Pedestrian(u8),
    Bicyclist(u8),
    Motorcyclist(u8),
    Animal,
    Other,
}

use Code::*;

/// The name that a code gets here and the others that become it, in lower case. The first three are the classes of the
/// shipped networks, the rest names that the protocol `default` knows, where it has one.
const CLASSES: &[(Code, &str, &[&str])] = &[
    (Vehicle(5), "vehicle", &["car", "policecar", "longvehicle"]),
    (Pedestrian(0), "pedestrian", &["child"]),
    (Vehicle(8), "truck", &["concretetruck", "trashcan"]),
    (Pedestrian(2), "RoadWorker", &[]),
    (Bicyclist(1), "BicycleRider", &["bicycle", "cyclist"]),
    (Bicyclist(5), "ScooterRider", &["scooter"]),
    (Motorcyclist(2), "Motorcycle", &["motorcylerider", "motorcyclist"]),
    (Vehicle(6), "Bus", &[]),
    (Vehicle(7), "Van", &[]),
    (Vehicle(9), "Trailer", &[]),
    (Vehicle(10), "SpecialVehicle", &[]),
    (Vehicle(11), "Tram", &[]),
    (Vehicle(14), "Agricultural", &[]),
    (Animal, "Animal", &[]),
    (Other, UNKNOWN, &[]),
];

/// The class of a name, letter case ignored.
pub(crate) fn class_of(name: &str) -> ObjectClass {
    let is = |known: &str| known.eq_ignore_ascii_case(name);
    let found = CLASSES
        .iter()
        .find(|(_, own, others)| is(own) || others.iter().any(|other| is(other)));
    match found.map_or(Other, |(code, ..)| *code) {
        Vehicle(number) => ObjectClass::vehicleSubClass(TrafficParticipantType(number)),
        Pedestrian(number) => vulnerable(VruProfileAndSubprofile::pedestrian(VruSubProfilePedestrian(number))),
        Bicyclist(number) => vulnerable(VruProfileAndSubprofile::bicyclistAndLightVruVehicle(
            VruSubProfileBicyclist(number),
        )),
        Motorcyclist(number) => vulnerable(VruProfileAndSubprofile::motorcyclist(VruSubProfileMotorcyclist(number))),
        Animal => vulnerable(VruProfileAndSubprofile::animal(VruSubProfileAnimal(0))),
        Other => ObjectClass::otherSubClass(OtherSubClass(0)),
    }
}

fn vulnerable(profile: VruProfileAndSubprofile) -> ObjectClass {
    ObjectClass::vruSubClass(profile)
}

/// The name of a class; a subclass without a name of its own has that of its class. A vehicle of no known type and a group
/// are [`UNKNOWN`].
pub(crate) fn name_of(class: &ObjectClass) -> &'static str {
    let code = match class {
        ObjectClass::vehicleSubClass(participant) => match participant.0 {
            1 => Pedestrian(0),
            2 => Bicyclist(1),
            3 | 4 => Motorcyclist(2),
            12 => Bicyclist(5),
            13 => Animal,
            number => Vehicle(number),
        },
        ObjectClass::vruSubClass(profile) => match profile {
            VruProfileAndSubprofile::pedestrian(profile) => match profile.0 {
                2 => Pedestrian(2),
                _ => Pedestrian(0),
            },
            VruProfileAndSubprofile::bicyclistAndLightVruVehicle(profile) => match profile.0 {
                4..=6 => Bicyclist(5),
                _ => Bicyclist(1),
            },
            VruProfileAndSubprofile::motorcyclist(_) => Motorcyclist(2),
            VruProfileAndSubprofile::animal(_) => Animal,
            _ => Other,
        },
        _ => Other,
    };
    let found = CLASSES.iter().find(|(known, ..)| *known == code);
    found.map_or(UNKNOWN, |(_, name, _)| name)
}

/// Whether it walks: such an object has no front that others would miss.
pub(crate) fn walks(class: &ObjectClass) -> bool {
    matches!(class, ObjectClass::vruSubClass(VruProfileAndSubprofile::pedestrian(_)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_the_networks_and_of_the_codes_come_back() {
        for (_, name, others) in CLASSES {
            assert_eq!(name_of(&class_of(name)), *name);
            for other in *others {
                assert_eq!(name_of(&class_of(&other.to_uppercase())), *name);
            }
        }
        assert_eq!(name_of(&class_of("Car")), "vehicle");
        assert_eq!(name_of(&class_of("sofa")), UNKNOWN);
        assert_eq!(name_of(&class_of("")), UNKNOWN);
    }

    #[test]
    fn every_number_of_a_class_has_a_name() {
        let names: Vec<&str> = (0..=255)
            .map(|number| name_of(&ObjectClass::vehicleSubClass(TrafficParticipantType(number))))
            .collect();
        let expected = [
            UNKNOWN,
            "pedestrian",
            "BicycleRider",
            "Motorcycle",
            "Motorcycle",
            "vehicle",
            "Bus",
            "Van",
            "truck",
            "Trailer",
            "SpecialVehicle",
            "Tram",
            "ScooterRider",
            "Animal",
            "Agricultural",
        ];
        assert_eq!(names[..15], expected);
        assert!(names[15..].iter().all(|name| *name == UNKNOWN));
        for number in 0..16 {
            let rider = VruProfileAndSubprofile::bicyclistAndLightVruVehicle(VruSubProfileBicyclist(number));
            assert_ne!(name_of(&vulnerable(rider)), UNKNOWN);
        }
    }
}
